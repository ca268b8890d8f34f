"""Which segments are labelled, by which version of the model, and which are due next."""

from collections.abc import Callable

import numpy as np

from codetr_ros.records import I64

_NEVER = -1


class LabelAges:
    """The version of the model that labelled each segment.

    Ages are in versions since then: in gradient steps, for a method that takes such.
    """

    def __init__(self) -> None:
        self._ids = np.empty(0, np.int64)
        self._versions = np.empty(0, np.int64)

    def follow(self, ids: I64) -> None:
        """Take note of what segments the memory holds now; others are forgotten."""
        versions = np.full(len(ids), _NEVER, np.int64)
        _, here, before = np.intersect1d(ids, self._ids, assume_unique=True, return_indices=True)
        versions[here] = self._versions[before]
        self._ids, self._versions = ids, versions

    def due(self, version: int, lengths: Callable[[I64], I64], most: int) -> I64:
        """Segments to be labelled by a version of the model, in the order of their ids.

        All that have no label, and of those with a label of another version all (`most` 0), or
        whole segments of at most so many steps, those with the oldest labels first, among equals
        those with the lowest id; one at least.

        Args:
            version: of the model.
            lengths: gives the steps of segments by id.
            most: steps of segments that are labelled again.
        """
        stale = (self._versions != version) & (self._versions != _NEVER)
        if most:
            places = np.flatnonzero(stale)
            places = places[np.argsort(self._versions[places], kind='stable')]
            enough = np.searchsorted(np.cumsum(lengths(self._ids[places])), most, side='right')
            stale[places[max(1, int(enough)) :]] = False
        found: I64 = self._ids[stale | (self._versions == _NEVER)]
        return found

    def label(self, ids: I64, version: int) -> None:
        """Take note that segments have been labelled."""
        self._versions[np.searchsorted(self._ids, ids)] = version

    def metrics(self, version: int, lengths: Callable[[I64], I64]) -> dict[str, float]:
        """How old labels are: the mean over all labelled steps, and the oldest."""
        labelled = self._versions != _NEVER
        if not labelled.any():
            return {}
        ages = version - self._versions[labelled]
        steps = lengths(self._ids[labelled])
        mean = float((ages * steps).sum() / steps.sum())
        return {'label_age_mean': mean, 'label_age_max': float(ages.max())}
