"""How a node has left a run, where nobody has received that.

A node that is asked to end does not wait for others that are held: on a busy machine they may miss
its last presence, and its process is gone when they look. Its report was written before.
"""

from dataclasses import replace
from pathlib import Path

from codetr_ros.nodes.peers import GAVE_UP, Peers
from codetr_ros.records.bounds import LONGEST_DOING
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports


def take_reports(peers: Peers, folder: Path, now: float) -> None:
    """Note of each node whose process is gone what its last presence stated, by its report. Who
    has left none was killed.

    Args:
        peers: the other nodes.
        folder: of the run, in which this node and they leave their reports.
        now: monotonic time [s].

    Raises:
        RunFolderError: a report is damaged.
    """
    for peer in peers.gone():
        presence = peer.presence
        path = run_folder.report_path(folder, presence.role, presence.node)
        if not path.is_file():
            continue
        error = reports.read(path).error
        last = replace(
            presence,
            finished=True,
            settings_hash='' if error else presence.settings_hash,
            doing=f'{GAVE_UP}{error}'[:LONGEST_DOING] if error else 'has finished',
            waiting=0.0,
        )
        peers.note(last, now)


def forget_report(folder: Path, role: str, name: str) -> None:
    """Remove the report of an earlier process of a node that begins.

    Args:
        folder: of the run.
        role: the node's role.
        name: its name.
    """
    run_folder.report_path(folder, role, name).unlink(missing_ok=True)
