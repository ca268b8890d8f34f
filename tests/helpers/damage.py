"""Damages bags in every way we can think of, and judges what reading makes of them."""

import os
import random
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codetr_ros.bags.definitions import bundled_text, encode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.verify import verify
from codetr_ros.bags.writer import McapWriter
from codetr_ros.records import TOPICS, Record
from codetr_ros.records.fields import type_name
from helpers.bags import WRITERS, a_run, ours
from helpers.builders import same

MEMORY = 16 << 20
"""Bytes that reading a damaged bag of these sizes (150 kB) may take, whatever it claims."""
RUN = a_run()


@dataclass
class Tally:
    """How cases of one kind ended."""

    cases: int = 0
    refused: int = 0  # by the reader, with a BagError
    late: int = 0  # of these: after it had given out something else than was written
    found: int = 0  # by `verify`
    neither: int = 0  # and what is read is what was written
    missed: list[str] = field(default_factory=list)  # neither, and what is read is something else
    peak: int = 0  # bytes of memory


def killed(folder: Path, records: Iterable[Record]) -> Path:
    """Our recorder's bag, killed after its last flush."""
    ours(folder, records)
    (folder / 'metadata.yaml').unlink()
    path = folder / 'bag_0.mcap'
    data = path.read_bytes()
    summary = int.from_bytes(data[-28:-20], 'little')
    os.truncate(path, summary - 13)  # the record that ends the data has 13 bytes
    return folder


SOUND: dict[str, Callable[..., Path]] = {**WRITERS, 'ours, killed': killed}
CHECKED = ('ours', 'ours, killed', 'mcap', 'mcap-zstd', 'mcap-lz4')
"""Formats whose chunks carry a CRC: no changed value may pass."""


def storage(bag: Path) -> Path:
    (path,) = [path for path in bag.iterdir() if path.name != 'metadata.yaml']
    return path


# ------------------------------------------------------------------------------------------------
# damage: each takes a bag in a folder of its own, and a generator


def cut(bag: Path, rng: random.Random) -> None:
    path = storage(bag)
    os.truncate(path, rng.randrange(path.stat().st_size))


def flip(bag: Path, rng: random.Random) -> None:
    edit(
        storage(bag), rng, lambda data, at: data.__setitem__(at, data[at] ^ 1 << rng.randrange(8))
    )


def overwrite(bag: Path, rng: random.Random) -> None:
    n = rng.choice((2, 8, 64, 512))
    edit(storage(bag), rng, lambda data, at: data.__setitem__(slice(at, at + n), rng.randbytes(n)))


def blank(bag: Path, rng: random.Random) -> None:
    """A block of the disk reads as zeros."""
    path = storage(bag)
    data = bytearray(path.read_bytes())
    at = rng.randrange(0, len(data), 512)
    data[at : at + 512] = bytes(len(data[at : at + 512]))
    path.write_bytes(data)


def insert(bag: Path, rng: random.Random) -> None:
    edit(storage(bag), rng, lambda data, at: data.__setitem__(slice(at, at), rng.randbytes(3)))


def edit(path: Path, rng: random.Random, change: Callable[[bytearray, int], None]) -> None:
    data = bytearray(path.read_bytes())
    change(data, rng.randrange(len(data)))
    path.write_bytes(data)


def pieces(path: Path) -> list[bytes]:
    """The file, split before each chunk."""
    data = path.read_bytes()
    starts = sorted({entry.place.offset for entry in Bag(path, lambda damage: None).entries()})
    return [data[a:b] for a, b in zip([0, *starts], [*starts, len(data)], strict=True)]


def swap_chunks(bag: Path, rng: random.Random) -> None:
    head, *chunks = pieces(storage(bag))
    a, b = rng.sample(range(len(chunks) - 1), 2)  # the last has the summary behind it
    chunks[a], chunks[b] = chunks[b], chunks[a]
    storage(bag).write_bytes(head + b''.join(chunks))


def lose_chunk(bag: Path, rng: random.Random) -> None:
    parts = pieces(storage(bag))
    del parts[rng.randrange(1, len(parts) - 1)]
    storage(bag).write_bytes(b''.join(parts))


def repeat_chunk(bag: Path, rng: random.Random) -> None:
    parts = pieces(storage(bag))
    at = rng.randrange(1, len(parts) - 1)
    parts.insert(rng.randrange(1, len(parts) - 1), parts[at])
    storage(bag).write_bytes(b''.join(parts))


def metadata_missing(bag: Path, rng: random.Random) -> None:
    (bag / 'metadata.yaml').unlink()


def metadata_of_another_version(bag: Path, rng: random.Random) -> None:
    path = bag / 'metadata.yaml'
    version = rng.choice((0, -1, 10, 11, 2**40, '"nine"', '[]', '{a: 1}', '1.5e300'))
    path.write_text(re.sub(r'version: \d', f'version: {version}', path.read_text(), count=1))


def metadata_cut(bag: Path, rng: random.Random) -> None:
    path = bag / 'metadata.yaml'
    os.truncate(path, rng.randrange(path.stat().st_size))


def metadata_flipped(bag: Path, rng: random.Random) -> None:
    path = bag / 'metadata.yaml'
    edit(path, rng, lambda data, at: data.__setitem__(at, data[at] ^ 1 << rng.randrange(8)))


def mix_runs(bag: Path, rng: random.Random) -> None:
    """Two runs that shared a namespace, interleaved as they came."""
    other = a_run(seed=rng.randrange(2**31), run_id=rng.choice(('other', 'run ', 'Run')))
    queues = [list(RUN), other[: rng.randrange(1, len(other))]]
    mixed = []
    while any(queues):
        mixed.append(rng.choice([queue for queue in queues if queue]).pop(0))
    shutil.rmtree(bag)
    ours(bag, mixed)


def mix_files(bag: Path, rng: random.Random) -> None:
    """A file of another run lies in the folder."""
    name = rng.choice(('other', 'run '))
    other = ours(bag.parent / 'other', a_run(seed=rng.randrange(2**31), run_id=name))
    shutil.copy(storage(other), bag / 'bag_1.mcap')


def wrong_definition(bag: Path, rng: random.Random) -> None:
    """One field of one type is defined otherwise; the bytes are as they were."""
    shutil.rmtree(bag)
    wrong = rng.choice(sorted({type_name(type(record)) for record in RUN}))
    store = get_typestore(Stores.ROS2_JAZZY)
    with RosbagsWriter(bag, version=9) as writer:
        connections = {}
        for record in RUN:
            name = type_name(type(record))
            if name not in connections:
                text = bundled_text(name)
                if name == wrong:
                    text = redefined(text, rng)
                store.register(get_types_from_msg(text, name))
                topic = f'/run/{TOPICS[type(record)]}'
                connections[name] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[name], 1, encode(record))


def redefined(text: str, rng: random.Random) -> str:
    lines = [
        line for line in text.splitlines() if line[:1].isalpha() and '=' not in line.split('#')[0]
    ]
    lines = [line.split('#')[0] for line in lines]
    at = rng.randrange(1, len(lines))
    kind, name = lines[at].split()
    how = rng.choice(('rename', 'retype', 'drop', 'swap', 'add'))
    if how == 'rename':
        lines[at] = f'{kind} {name}x'
    elif how == 'retype':
        lines[at] = f'{"uint16" if kind != "uint16" else "int16"} {name}'
    elif how == 'drop':
        del lines[at]
    elif how == 'swap':
        lines[at], lines[at - 1] = lines[at - 1], lines[at]
    else:
        lines.insert(at, 'uint8 more')
    return '\n'.join(lines)


def length_field(bag: Path, rng: random.Random) -> None:
    """A length in a message says ten million or more; every CRC is right."""
    lengthened = rng.randrange(len(RUN))
    topics = [BagTopic(f'/run/{t}', type_name(k), 9, False) for k, t in TOPICS.items()]
    shutil.rmtree(bag)
    writer = McapWriter(bag, topics, chunk_bytes=1500)
    for i, record in enumerate(RUN):
        data = bytearray(encode(record))
        if i == lengthened:
            at = rng.choice(lengths(record, bytes(data)))
            claimed = rng.choice((10_000_000, 2**32 - 1, 2**31, 40_000_000))
            data[at : at + 4] = claimed.to_bytes(4, 'little')
        writer.write(f'/run/{TOPICS[type(record)]}', bytes(data), 1000 + i)
    writer.close()


def lengths(record: Record, data: bytes) -> list[int]:
    """Where in a message the lengths of its texts and arrays are."""
    found = []
    for known in fields(record):
        value = getattr(record, known.name)
        if isinstance(value, str):
            text = value.encode() + b'\0'
            found.append(data.find(len(text).to_bytes(4, 'little') + text))
        elif isinstance(value, np.ndarray) and value.itemsize == 4:
            found.append(data.find(value.size.to_bytes(4, 'little') + value.tobytes()))
    return [at for at in found if at >= 0]


def empty(bag: Path, rng: random.Random) -> None:
    os.truncate(storage(bag), 0)


def folder(bag: Path, rng: random.Random) -> None:
    path = storage(bag)
    path.unlink()
    path.mkdir()


def loop(bag: Path, rng: random.Random) -> None:
    path = storage(bag)
    path.unlink()
    path.symlink_to(path.name)


def forbidden(bag: Path, rng: random.Random) -> None:
    storage(bag).chmod(0)


# ------------------------------------------------------------------------------------------------
# what comes of it

KINDS: dict[str, tuple[Callable[[Path, random.Random], None], tuple[str, ...]]] = {
    'cut at any byte': (
        cut, ('ours', 'ours, killed', 'mcap-zstd', 'mcap-lz4', 'rosbags-mcap', 'rosbags-sqlite-9'),
    ),
    'any bit flipped': (
        flip,
        ('ours', 'ours, killed', 'mcap', 'mcap-zstd', 'mcap-lz4', 'rosbags-mcap-zstd-file',
         'rosbags-mcap', 'rosbags-sqlite-9'),
    ),
    'bytes overwritten': (overwrite, ('ours', 'mcap-zstd', 'mcap-lz4', 'rosbags-sqlite-9')),
    'a block of zeros': (blank, ('ours', 'ours, killed', 'rosbags-sqlite-9')),
    'bytes inserted': (insert, ('ours',)),
    'chunks swapped': (swap_chunks, ('ours', 'ours, killed')),
    'a chunk lost': (lose_chunk, ('ours', 'ours, killed')),
    'a chunk repeated': (repeat_chunk, ('ours', 'ours, killed')),
    'metadata missing': (metadata_missing, ('ours', 'rosbags-sqlite-9')),
    'metadata of another version': (metadata_of_another_version, ('ours', 'rosbags-sqlite-8')),
    'metadata cut': (metadata_cut, ('ours',)),
    'a bit of the metadata flipped': (metadata_flipped, ('ours',)),
    'two runs mixed': (mix_runs, ('ours',)),
    'files of two runs mixed': (mix_files, ('ours',)),
    'a wrong definition': (wrong_definition, ('rosbags-sqlite-9',)),
    'a length of ten million': (length_field, ('ours',)),
    'an empty file': (empty, ('ours', 'rosbags-sqlite-9')),
    'a folder in place of the file': (folder, ('ours', 'rosbags-sqlite-9')),
    'a loop of links': (loop, ('ours', 'rosbags-sqlite-9')),
    'no permission': (forbidden, ('ours', 'rosbags-sqlite-9')),
}  # fmt: skip


def resident(what: str = 'VmRSS') -> int:
    """Bytes of memory that this process has, or has had at most."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(what))


ORDERLY = ('cut at any byte', 'any bit flipped', 'bytes overwritten', 'a block of zeros')
"""Damage that changes bytes in place or takes the end away: what is read before it is noticed must
be what was written. Where chunks change places, that is so of each message, not of their order."""


def judge(bag: Path, tally: Tally, case: str) -> None:
    """Read a damaged bag in every way, and note how that ended.

    Raises:
        AssertionError: reading gave out what was not written, although an error followed, or took
            more memory than it may.
    """
    tally.cases += 1
    before = resident()
    Path('/proc/self/clear_refs').write_text('5')  # the peak begins anew
    refused, equal = _strictly(bag)
    found = _verified(bag)
    for _ in _tolerantly(bag):
        pass
    tally.peak = max(tally.peak, resident('VmHWM') - before)
    tally.refused += refused
    tally.late += refused and not equal
    tally.found += found
    if not refused and not found:
        if equal:
            tally.neither += 1
        else:
            tally.missed.append(case)


def _strictly(bag: Path) -> tuple[bool, bool]:
    """Whether reading is refused; whether what was read is what was written."""
    read = 0
    equal = True
    try:
        for entry in Bag(bag).entries():
            equal &= read < len(RUN) and same(entry.record, RUN[read])
            read += 1
    except BagError:
        return True, equal
    return False, equal and read == len(RUN)


def _tolerantly(bag: Path) -> Iterable[Record]:
    said: list[object] = []
    try:
        for entry in Bag(bag, said.append).entries():
            yield entry.record
    except BagError:
        return


def _verified(bag: Path) -> bool:
    try:
        return not verify(bag).sound
    except BagError:
        return True


def run_cases(kind: str, made_by: str, cases: int, folder: Path, seed: int = 0) -> Tally:
    """Damage as many bags, and judge each."""
    damage, _ = KINDS[kind]
    sound = SOUND[made_by](folder / 'bag', RUN)
    tally = Tally()
    for number in range(cases):
        rng = random.Random(f'{kind} {made_by} {seed} {number}')
        bag = folder / 'case' / 'bag'
        shutil.rmtree(bag.parent, ignore_errors=True)
        shutil.copytree(sound, bag)
        damage(bag, rng)
        judge(bag, tally, f'{number}')
    return tally


def table(tallies: dict[tuple[str, str], Tally]) -> str:
    """What was tried and what came of it, as Markdown."""
    lines = [
        '# Damaged bags: what was tried, and what came of it',
        '',
        'Made by `tests/bags/test_damage.py` (its head says how). Each case damages a sound bag '
        f'of {len(RUN)} messages at random, reads it, reads past its faults, and verifies it. '
        '*Late*: the reader had given out something else than was written before it refused. '
        f'Files of these writers carry CRCs: {", ".join(CHECKED)}; the others do not, and what is '
        'changed in them can be another possible number. The file of a killed recorder is refused '
        'for its missing end in any case: there *late* is what counts. No case ended in anything '
        'but a named error.',
        '',
        '| damage | bag written by | cases | refused by the reader | of these, late | '
        'found by `verify` | '
        'neither, and nothing that is read was changed | changed and not found | peak memory |',
        '|---|---|---:|---:|---:|---:|---:|---:|---:|',
    ]
    for (kind, made_by), tally in tallies.items():
        lines.append(
            f'| {kind} | {made_by} | {tally.cases} | {tally.refused} | {tally.late} | '
            f'{tally.found} | {tally.neither} | {len(tally.missed)} | {tally.peak / 1e6:.1f} MB |'
        )
    total = Counter[str]()
    for tally in tallies.values():
        total['cases'] += tally.cases
        total['missed'] += len(tally.missed)
    lines.append(f'\n{total["cases"]} cases, {total["missed"]} changed and not found.')
    return '\n'.join(lines) + '\n'
