"""Launch files, and what they give the nodes that they start."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from launch_ros.utilities import evaluate_parameters

FOLDER = Path(__file__).resolve().parents[2] / 'codetr_ros' / 'launch'


def launch_file(name):
    """A launch file as a module."""
    spec = spec_from_file_location(name.replace('.', '_'), FOLDER / name)
    made = module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def parameters(node, context):
    """Names and values of the parameters that a node is given."""
    found = {}
    for each in evaluate_parameters(context, node._Node__parameters):
        found |= each
    return found
