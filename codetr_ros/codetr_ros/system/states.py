"""States of learners and reward models, as checkpoints hold them: tensors by name."""

from collections.abc import Mapping

from torch import Tensor

SHOWN = 5
"""The most faults that an error names; it counts the others."""


def check_state(
    owner: str,
    expected: Mapping[str, Tensor],
    given: Mapping[str, Tensor],
    error: type[ValueError],
) -> None:
    """Refuse a state of another owner or architecture.

    Args:
        owner: whose state is expected, for the error: "policy learner 'sac'".
        expected: a state of it, for names, shapes and types.
        given: the state to be loaded.
        error: the type to raise.

    Raises:
        ValueError: of the type `error`: a tensor is missing, unknown, of another shape or type,
            or has values that are not finite.
    """
    faults = [f'{name} is missing' for name in expected if name not in given]
    faults += [f'{name} is unknown' for name in given if name not in expected]
    for name in (name for name in expected if name in given):
        tensor, due = given[name], expected[name]
        if (tensor.shape, tensor.dtype) != (due.shape, due.dtype):
            faults.append(
                f'{name} is {tuple(tensor.shape)} {tensor.dtype}, '
                f'expected {tuple(due.shape)} {due.dtype}'
            )
        elif tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            faults.append(f'{name} has values that are not finite')
    if faults:
        more = f' and {len(faults) - SHOWN} more' if len(faults) > SHOWN else ''
        raise error(
            f'state of {owner} refused: {"; ".join(faults[:SHOWN])}{more}. '
            'It belongs to other settings or another task: use those it was saved with'
        )
