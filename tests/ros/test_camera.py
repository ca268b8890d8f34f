"""The page to score beside a camera: pictures over a real topic, and those that are refused."""

import json
import re
import time
import urllib.request

import imageio.v3 as iio
import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage, Image

from codetr_ros.ros.camera import wrong_topic
from helpers.builders import task_spec, tiny, transitions
from helpers.judging import CODETR, Command
from helpers.playing import NAMESPACE

SETTINGS = tiny(scorer='person')  # segments of 7 steps
PERIOD = 1000.0  # [s] of a step: no machine is so slow that a picture is of another segment
EVERYBODY = ('learner', 'sim', 'reward', 'record', 'evaluate')
GREEN = Image(encoding='rgb8', width=4, height=2, step=12, data=bytes([0, 200, 0] * 8))
TORN = Image(encoding='rgb8', width=4, height=2, step=12, data=bytes(5))
JPEG = iio.imwrite('<bytes>', np.full((2, 4, 3), 90, np.uint8), extension='.jpg')


def shown(url, first):
    sent = json.dumps({'segment': ['sim', 0, first, 7], 'frames': True}).encode()
    request = urllib.request.Request(url + 'segment', sent, {'Content-Type': 'application/json'})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.loads(answer.read())


@pytest.mark.parametrize(
    ('sound', 'torn', 'why'),
    [
        (GREEN, TORN, '4 x 2 pixels rgb8 in rows of 12 bytes do not fit 5 bytes'),
        (CompressedImage(data=JPEG), CompressedImage(data=JPEG[:20]), 'it is damaged'),
    ],
    ids=['raw', 'compressed'],
)
def test_the_page_shows_what_a_camera_saw_of_a_segment_and_counts_what_it_refuses(
    play, sound, torn, why
):
    play = play(settings=SETTINGS, roles=EVERYBODY)
    sim = play.links['sim']
    eye = sim.node.create_publisher(type(sound), '/eye', 10)
    with Command((*CODETR, 'score', NAMESPACE, '--name', 'ann', '--camera', '/eye')) as page:

        def stated(pattern):
            assert page.process.poll() is None, page.text
            return re.search(pattern, page.text)

        play.until(lambda: stated(r'shows pictures of /eye'))
        url = stated(r'score as ann at (http\S+)')[1]
        sim.publish(task_spec(control_period=PERIOD))
        now = int(time.time())
        sim.publish(transitions(steps=70))

        def seen(image, first, found):
            image.header.stamp.sec = now - round(3.5 * PERIOD)  # amid the last segment
            eye.publish(image)
            answer = shown(url, first)
            return answer if found(answer) else None

        answer = play.until(lambda: seen(sound, 63, lambda it: it['frames']))
        assert answer['frames'][0].startswith('data:image/jpeg;base64,')
        assert 'pictures on /eye' in answer['note']
        other = shown(url, 56)
        assert other['frames'] == [] and 's before the oldest one held' in other['note']
        play.until(lambda: seen(torn, 63, lambda it: 'refused' in it['note']))
        play.until(lambda: stated(why))


@pytest.mark.slow
def test_a_topic_of_another_type_is_named_on_the_page(play):
    play = play(settings=SETTINGS, roles=EVERYBODY)
    sim = play.links['sim']
    with Command((*CODETR, 'score', NAMESPACE, '--camera', 'presence')) as page:
        url = play.until(lambda: re.search(r'score as person at (http\S+)', page.text))[1]
        sim.publish(task_spec(control_period=PERIOD))

        def stated():
            sim.publish(transitions(steps=70))
            return 'has type codetr_msgs/msg/Presence' in shown(url, 63)['note']

        play.until(stated)


@pytest.mark.parametrize(
    ('topic', 'fine'), [('/eye/image_raw', True), ('eye', True), ('/1 x', False)]
)
def test_a_name_that_no_topic_can_have_is_refused(topic, fine):
    assert (wrong_topic(topic) is None) == fine
