"""A node that joins a run which has begun asks the recorder for what it needs, and waits."""

from collections.abc import Callable

from codetr_ros.nodes.asking import SERVICE
from codetr_ros.nodes.restoring import Restoring, Returning, Steps
from codetr_ros.ros.fetch import Asker
from codetr_ros.ros.gathering import wait_for
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership


def returning(member: Membership, joined: Joined) -> Returning:
    """A node that has joined, as what restores it needs it."""
    return Returning(
        role=member.role,
        name=member.link.name,
        core=joined.core,
        settings=joined.settings,
        peers=member.peers,
        catch_up=member.catch_up,
        begin_counting_anew=member.begin_counting_anew,
        log=member.log,
    )


def ask_recorder(
    member: Membership,
    joined: Joined,
    steps: Steps,
    over: Callable[[], bool] = lambda: False,
) -> bool:
    """Ask the recorder one question after the other, and wait for each answer.

    Args:
        member: asks.
        joined: the run.
        steps: the questions.
        over: whether nothing needs to be answered any more.

    Returns:
        False if asked to stop meanwhile.

    Raises:
        NodeError: the recorder refuses to send something, or does not answer.
        RecordError: a message cannot be decoded, is out of bounds or not signed.
        CheckpointError: a checkpoint is of another run.
        TaskError: an environment is at fault.
    """
    recorder = Asker(member.link, SERVICE, joined.run.run_id)
    asking = Restoring(recorder, member.traffic.fetched, member.link.full_name, steps)

    def lacking() -> list[str]:
        return [] if over() else asking.lacking()

    return not lacking() or wait_for(member, lacking, member.peers.cause)
