"""Segments that a report shows step by step, and their pictures."""

import io

import matplotlib.colors
import matplotlib.image
import numpy as np
import pytest

from codetr_ros.runs import pictures, segments
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.segments import Segment, spread_evenly


def one(**changes) -> Segment:
    values = {
        'source': 'sim',
        'episode': 3,
        'first': 25,
        'value': 1.5,
        'labels': np.array([0.1, 0.25, -1 / 3], np.float32),
        'true': np.array([1.0, 0.0, 0.5], np.float32),
    }
    return Segment(**values | changes)


def test_places_are_spread_evenly_from_the_lowest_to_the_highest_value():
    values = [5.0, 1.0, 9.0, 3.0, 7.0]

    assert [values[i] for i in spread_evenly(values, 3)] == [1.0, 5.0, 9.0]
    assert [values[i] for i in spread_evenly(values)] == sorted(values)
    assert spread_evenly([]) == []


def test_segments_come_back_from_their_file_bit_for_bit(tmp_path):
    shown = [one(), one(first=28, value=None, true=None), one(episode=4, source='sim_2')]
    path = tmp_path / 'step_rewards.csv'
    path.write_text(segments.to_csv(shown))

    again = segments.read_csv(path)

    for made, read in zip(shown, again, strict=True):
        assert (read.source, read.episode, read.first) == (made.source, made.episode, made.first)
        assert read.value == made.value
        assert read.labels.tobytes() == made.labels.tobytes()
        assert (read.true is None) == (made.true is None)
        assert made.true is None or read.true.tobytes() == made.true.tobytes()


@pytest.mark.parametrize('text', ['a,b\n1,2\n', 'source,episode,first_step\nsim,x,0\n'])
def test_a_file_that_holds_no_segments_is_refused_by_name(tmp_path, text):
    path = tmp_path / 'step_rewards.csv'
    path.write_text(text)
    with pytest.raises(RunFolderError, match=f'{path} is not a file of step rewards .*remove it'):
        segments.read_csv(path)


def colours(picture: bytes) -> dict[str, int]:
    """The number of pixels in the colour of what is true, and of what is inferred."""
    pixels = matplotlib.image.imread(io.BytesIO(picture))[..., :3]
    return {
        name: int((np.abs(pixels - matplotlib.colors.to_rgb(colour)).max(-1) < 0.02).sum())
        for name, colour in (('true', pictures.TRUE), ('inferred', pictures.INFERRED))
    }


def test_a_segment_shows_inferred_and_true_rewards_where_both_are_known():
    both, blind = (colours(pictures.segment(each)) for each in (one(), one(true=None)))

    assert both['true'] > 500
    assert both['inferred'] > 500
    assert blind['true'] == 0
    assert blind['inferred'] > 500


@pytest.mark.parametrize(('points', 'least'), [(1, 40), (30, 1000), (50_000, 5000)])
def test_the_dots_of_a_scatter_plot_can_be_seen_however_few_or_many_they_are(points, least):
    rng = np.random.default_rng(0)
    x = rng.normal(size=points)

    def draw(figure):
        pictures.scatter(figure.subplots(), x, x + rng.normal(size=points), 'caption')

    pixels = matplotlib.image.imread(io.BytesIO(pictures.png((5, 4.5), draw)))[..., :3]
    # blue beyond the grey of grid and text
    assert int((pixels[..., 2] - pixels[..., 0] > 0.15).sum()) > least
