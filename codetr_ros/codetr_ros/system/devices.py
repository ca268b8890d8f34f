"""The devices that torch can use here."""

import torch


class DeviceError(ValueError):
    """A device that is not available, or has no room: names value, field and remedy."""


def usable(device: str, field: str = 'device') -> torch.device:
    """A device by its name, after a check that torch can use it.

    Args:
        device: cpu, cuda, cuda:1, ...
        field: the setting that names it, for the error.

    Raises:
        DeviceError: it cannot; names the reason and the remedy.
    """
    wanted = torch.device(device)
    if wanted.type == 'cpu':
        return wanted
    remedy = f'or set {field}=cpu'
    if not torch.cuda.is_available():
        if torch.version.cuda is None and torch.version.hip is None:
            why, do = 'was built without CUDA', 'Install a build with it from pytorch.org'
        else:
            why, do = 'finds no GPU', 'See what nvidia-smi lists and CUDA_VISIBLE_DEVICES hides'
        raise DeviceError(f'{field}={device}: torch {torch.__version__} {why}. {do}, {remedy}')
    count, index = torch.cuda.device_count(), wanted.index or 0
    if index >= count:
        raise DeviceError(
            f'{field}={device}: torch finds {count} GPUs, the last is cuda:{count - 1}. '
            f'Name one of them, {remedy}'
        )
    return torch.device('cuda', index)
