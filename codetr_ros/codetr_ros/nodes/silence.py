"""Which sources are silent, so that a phase need not wait for them."""

from codetr_ros.config import Settings
from codetr_ros.nodes.peers import Peers


def silent_sources(peers: Peers, settings: Settings, now: float, after: float) -> list[str]:
    """The sources of simulators that have published no presence for a while, or have ended.

    Args:
        peers: the nodes of the run.
        settings: its settings.
        now: monotonic time [s].
        after: seconds of silence; 0: nobody is silent, however long nothing comes.
    """
    if not after:
        return []
    silent = [
        peer.presence.node.rpartition('/')[2]
        for peer in peers.alive('sim')
        if peer.presence.finished or now - peer.received_at > after
    ]
    return [source for name in silent for source in settings.sources_of(name)]
