"""A bag that an older version of this project recorded, kept as it was written."""

from pathlib import Path

import zstandard

RECORDED = Path(__file__).resolve().parents[1] / 'bags' / 'recorded'


def protocol_1(folder: Path) -> Path:
    """A run of 240 steps in 4 phases over topics, with method ircr and all labels, recorded before
    commits had digests; its file without metadata.
    """
    folder.mkdir(parents=True)
    packed = (RECORDED / 'protocol_1.mcap.zstd').read_bytes()
    file = folder / 'bag_0.mcap'
    file.write_bytes(zstandard.ZstdDecompressor().decompress(packed, 10**7))
    return file
