"""What compiling needs, where its results are kept, and what is said where it cannot be done."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from codetr_ros.cli import doctor
from codetr_ros.config import SacSettings
from codetr_ros.learners.flat_sac import FlatSAC
from codetr_ros.system import compilation
from codetr_ros.system.compilation import CompilationError


def test_without_a_compiler_the_error_says_what_to_install_and_what_to_switch_off(monkeypatch):
    monkeypatch.setenv('CXX', '/nowhere/g++')
    with pytest.raises(CompilationError) as error:
        FlatSAC(3, 1, SacSettings(hidden=(8,), compile=True), 0)
    for part in ("'/nowhere/g++'", 'CXX', 'apt install g++ python3-dev', 'sac.compile=false'):
        assert part in str(error.value)


def test_the_doctor_names_a_missing_compiler_and_its_remedy(monkeypatch):
    assert doctor.compiler in doctor.CHECKS
    monkeypatch.setenv('CXX', '/nowhere/g++')
    check = doctor.compiler()
    assert check.status == 'warn' and '/nowhere/g++' in check.detail
    assert 'apt install' in check.remedy and 'sac.compile=false' in check.remedy


def test_missing_headers_are_named(monkeypatch):
    monkeypatch.setattr(compilation.shutil, 'which', lambda command: command)
    monkeypatch.setattr(compilation.sysconfig, 'get_path', lambda name: '/nowhere/include')
    assert compilation.missing() == 'the header /nowhere/include/Python.h is missing'


def test_the_cache_lies_where_torch_or_the_desktop_standard_say(monkeypatch):
    monkeypatch.setenv('TORCHINDUCTOR_CACHE_DIR', '/some/where')
    assert compilation.cache_folder() == Path('/some/where')
    monkeypatch.delenv('TORCHINDUCTOR_CACHE_DIR')
    monkeypatch.setenv('XDG_CACHE_HOME', '/caches')
    assert compilation.cache_folder() == Path('/caches/codetr_ros/torch')
    monkeypatch.delenv('XDG_CACHE_HOME')
    assert compilation.cache_folder() == Path.home() / '.cache/codetr_ros/torch'


def test_a_cache_that_cannot_be_written_to_is_named_with_the_way_out(tmp_path, monkeypatch):
    (tmp_path / 'file').touch()
    monkeypatch.setattr(compilation, 'missing', lambda: '')
    monkeypatch.setenv('TORCHINDUCTOR_CACHE_DIR', str(tmp_path / 'file' / 'cache'))
    with pytest.raises(CompilationError) as error:
        FlatSAC(3, 1, SacSettings(hidden=(8,), compile=True), 0)
    for part in (f'{tmp_path}/file/cache', 'TORCHINDUCTOR_CACHE_DIR to a', 'sac.compile=false'):
        assert part in str(error.value)


@pytest.mark.slow
def test_a_torch_that_is_older_than_one_of_the_options_compiles_too(monkeypatch):
    """As on a GPU machine that brings torch 2.11: these are all arguments that it takes."""
    newer = torch.compile

    def older(model, *, fullgraph, dynamic, backend='inductor', mode=None, options=None):
        more = {'fullgraph': fullgraph, 'dynamic': dynamic, 'options': options}
        return newer(model, backend=backend, mode=mode, **more)

    monkeypatch.setattr(torch, 'compile', older)
    numbers = torch.arange(5.0)
    doubled = compilation.compiled(lambda x: x + x, [numbers], without='this=false')
    assert doubled(numbers).tolist() == [0, 2, 4, 6, 8]


BROKEN = """#!/bin/sh
[ "$1" = --version ] && { echo "g++ (Broken) 13.3.0"; exit 0; }
echo no room for objects >&2
exit 1
"""
COMPILE = """
import torch
from codetr_ros.system.compilation import compiled
compiled(lambda x: x.sin() + 1, [torch.zeros(5)], without='this=false')
"""


@pytest.mark.slow
def test_a_compiler_that_fails_is_quoted(tmp_path):
    broken = tmp_path / 'c++'
    broken.write_text(BROKEN)
    broken.chmod(0o700)
    environment = os.environ | {'CXX': str(broken), 'TORCHINDUCTOR_CACHE_DIR': str(tmp_path)}
    command = [sys.executable, '-c', COMPILE]
    ended = subprocess.run(
        command, check=False, env=environment, capture_output=True, text=True, timeout=250
    )
    assert ended.returncode == 1
    last = ended.stderr[ended.stderr.rindex('CompilationError') :]
    assert 'no room for objects' in last and 'or set this=false' in last
