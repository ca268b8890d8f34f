"""A person scores over topics, on the page beside `codetr train --scorer person`."""

import json
import os
import re
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest

from codetr_ros.bags.verify import verify
from helpers.nodes import domain

PATIENCE = 240.0
FLAGS = (
    *('--scorer', 'person', '--scorers', 'ann', '--task', 'InvertedPendulum-v5'),
    *('--delay', '10', '--steps', '3000', '--warmup-steps', '1000', '--phase-steps', '500'),
    *('--method', 'evidence', '--evaluate-every', '0', '--no-film'),
)


def desk_of(url):
    with urllib.request.urlopen(url + 'events', timeout=10) as stream:
        for line in stream:
            if line.startswith(b'data: {"scorer"'):
                return json.loads(line[6:])
    raise AssertionError('the page publishes no desk')


def judge(url, segment, value):
    sent = json.dumps({'segment': segment, 'value': value}).encode()
    request = urllib.request.Request(url + 'judge', sent, {'Content-Type': 'application/json'})
    with urllib.request.urlopen(request, timeout=10) as answer:
        return json.loads(answer.read())


@pytest.mark.slow
def test_what_a_person_states_on_the_page_is_taken_by_a_commit_and_learnt_from(tmp_path):
    out = tmp_path / 'run'
    command = [sys.executable, '-m', 'codetr_ros.cli', 'train', *FLAGS, '--out', str(out)]
    with domain():
        train = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ
        )
        lines = []
        addresses = threading.Event()

        def read():
            for line in train.stdout:
                lines.append(line)
                if 'score as ann at' in line:
                    addresses.set()

        reader = threading.Thread(target=read)
        reader.start()
        try:
            assert addresses.wait(PATIENCE), ''.join(lines)
            url = next(m[1] for m in (re.search(r'at (http\S+)', line) for line in lines) if m)
            given, taken, end = 0, set(), time.monotonic() + PATIENCE
            while not taken and time.monotonic() < end:
                desk = desk_of(url)
                for segment in desk['waiting'][:4]:
                    judge(url, segment, 1 + min(4, segment[3] // 2))
                    given += 1
                taken = {row['phase'] for row in desk['given'] if row['phase'] is not None}
        finally:
            code = train.wait(PATIENCE)
            reader.join()
    assert code == 0, ''.join(lines)
    assert taken, 'no commit took what was stated'
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['refused'] == summary['lost'] == 0
    assert summary['scorers']['ann']['scores'] > 0
    assert verify(Path(out / 'bag')).sound
