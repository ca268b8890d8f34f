"""The pictures of a camera: which are held, which belong to a segment, and what is refused."""

import base64
import io
import struct
import zlib

import imageio.v3 as iio
import numpy as np
import pytest

from codetr_ros.cores import camera
from codetr_ros.cores.camera import Camera, PictureError, decoded, unpacked
from helpers.builders import task_spec, transitions

S = 10**9
COLOURS = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


def grey(value, shape=(6, 8)):
    return np.full(shape, value, np.uint8)


def values(pictures):
    """What the pictures were made of, by their mean."""
    made = [base64.b64decode(frame.split(',')[1]) for frame in pictures.frames]
    return [round(float(iio.imread(each).mean())) for each in made]


def looked(times, **options):
    """A camera with pictures at these seconds, each as bright as its number, and seven steps
    from 100 to 107 s, of a second each.
    """
    it = Camera('/eye')
    it.note(task_spec(control_period=1.0, **options))
    with it.stamped(107 * S):
        it.note(transitions(steps=7))
    for number, at in enumerate(times):
        it.take(round(at * S), grey(min(250, 10 * number)))
    return it


def test_a_segment_has_the_pictures_from_its_first_step_to_its_last():
    it = looked([99.9, 100, 102.4, 102.6, 104.9, 105.1, 107])
    assert values(it(('sim', 0, 0, 7))) == [10, 20, 30, 40, 50, 60]
    assert values(it(('sim', 0, 3, 2))) == [40]
    assert it(('sim', 0, 3, 2)).note == '1 of 1 pictures on /eye (7 taken)'


def test_steps_that_come_in_several_messages_are_one_segment_and_none_began_before_the_last_one():
    it = looked([106, 107.2, 107.4, 108.5])
    with it.stamped(108 * S):  # a simulator is faster than its clock
        it.note(transitions(first_step=7, steps=10))
    assert values(it(('sim', 0, 5, 4))) == [0, 10]
    assert values(it(('sim', 0, 7, 10))) == [10, 20]


@pytest.mark.parametrize(
    ('times', 'segment', 'why'),
    [
        ([], ('sim', 0, 0, 7), 'nobody publishes pictures on /eye yet'),
        ([200], ('sim', 0, 0, 7), 'it ended 93.0 s before the oldest one held; camera and steps'),
        ([50], ('sim', 0, 0, 7), 'it began 50.0 s after the newest one; camera and steps must'),
        ([50, 200], ('sim', 0, 0, 7), 'none came meanwhile'),
        ([103], ('sim', 1, 0, 7), 'its time is not known'),
        ([103], ('sim', 0, 5, 7), 'its time is not known'),
    ],
)
def test_why_a_segment_has_no_pictures_is_stated(times, segment, why):
    shown = looked(times)(segment)
    assert shown.frames == [] and why in shown.note


def test_steps_whose_message_has_no_time_have_no_pictures():
    it = looked([103])
    it.note(transitions(first_step=7, steps=7))
    assert 'its time is not known' in it(('sim', 0, 7, 7)).note


def test_of_many_pictures_some_are_shown_from_the_first_to_the_last():
    it = looked(np.linspace(100, 107, 71))
    shown = it(('sim', 0, 0, 7))
    assert len(shown.frames) == 24 and values(shown)[0] == 0
    assert shown.note == '24 of 71 pictures on /eye (71 taken)'


@pytest.mark.parametrize('limit', ['MOST_FRAMES', 'MOST_BYTES'])
def test_the_oldest_are_let_go_of_and_counted(monkeypatch, limit):
    size = len(written('.jpg', grey(0))) + 9  # the others have nearly as many bytes
    monkeypatch.setattr(camera, limit, 3 if limit == 'MOST_FRAMES' else 3 * size)
    it = looked([100, 101, 102, 103, 104])
    shown = it(('sim', 0, 0, 7))
    assert values(shown)[-1] == 40 and len(shown.frames) <= 3
    assert f'{5 - len(shown.frames)} let go of, the oldest' in shown.note


def test_no_more_than_some_ten_a_second_are_taken_and_the_others_counted():
    it = Camera('/eye')
    assert [it.due(t) for t in (5.0, 5.03, 5.07, 5.1)] == [True, False, False, True]
    assert 'passed over' in it(('sim', 0, 0, 7)).note and it.counts.total() == 2


def written(extension, picture=COLOURS):
    file = io.BytesIO()
    iio.imwrite(file, picture, extension=extension)
    return file.getvalue()


def test_compressed_pictures_are_decoded():
    assert np.array_equal(decoded(written('.png')), COLOURS)
    assert decoded(written('.png', grey(7))).tolist() == np.full((6, 8, 3), 7).tolist()
    assert abs(decoded(written('.jpg', grey(90))).astype(int) - 90).max() <= 2


@pytest.mark.parametrize('encoding', ['rgb8', 'bgr8', 'mono8'])
def test_raw_pictures_are_unpacked_from_rows_with_a_margin(encoding):
    pixels = {'rgb8': COLOURS, 'bgr8': COLOURS[:, :, ::-1], 'mono8': COLOURS[:, :, 0]}[encoding]
    rows = np.zeros((6, 32), np.uint8)
    flat = pixels.reshape(6, -1)
    rows[:, : flat.shape[1]] = flat
    found = unpacked(encoding, 8, 6, 32, rows.tobytes())
    assert np.array_equal(found, COLOURS[:, :, 0] if encoding == 'mono8' else COLOURS)


def huge():
    """A PNG whose head promises 81 million pixels."""
    head = b'IHDR' + struct.pack('>IIBBBBB', 9000, 9000, 8, 2, 0, 0, 0)
    whole = struct.pack('>I', 13) + head + struct.pack('>I', zlib.crc32(head))
    return b'\x89PNG\r\n\x1a\n' + whole + written('.png')[33:]


@pytest.mark.parametrize(
    ('data', 'why'),
    [
        (b'', 'neither JPEG nor PNG'),
        (written('.gif'), 'neither JPEG nor PNG'),
        (written('.png')[:-40], 'it is damaged'),
        (written('.jpg')[:30], 'it is damaged'),
        (b'\xff\xd8\xff' + bytes(99), 'it is damaged'),
        (huge(), '9000 x 9000 pixels'),
    ],
)
def test_what_is_no_sound_picture_is_refused(data, why):
    with pytest.raises(PictureError, match=why):
        decoded(data)


@pytest.mark.parametrize(
    ('shape', 'why'),
    [
        (('yuv422', 8, 6, 16), "encoding 'yuv422': publish rgb8, bgr8, mono8"),
        (('rgb8', 8, 6, 23), 'do not fit 144 bytes'),
        (('rgb8', 8, 7, 24), 'do not fit 144 bytes'),
        (('mono8', 0, 6, 24), '0 x 6 pixels'),
        (('mono8', 2**32 - 1, 2**32 - 1, 2**32 - 1), 'pixels: 1 to 8388608 are taken'),
    ],
)
def test_raw_pictures_whose_sizes_disagree_are_refused(shape, why):
    with pytest.raises(PictureError, match=why):
        unpacked(*shape, bytes(144))


def test_a_large_picture_is_shown_smaller():
    it = looked([])
    it.take(103 * S, grey(50, (700, 1000)))
    (frame,) = it(('sim', 0, 0, 7)).frames
    assert iio.imread(base64.b64decode(frame.split(',')[1])).shape[:2] == (234, 334)
