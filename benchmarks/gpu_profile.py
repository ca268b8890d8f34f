"""How do host and GPU spend their time in a short run that learns on a GPU?

    .venv/bin/python benchmarks/gpu_profile.py

Two looks at a run of `gpu_runs.py`, group `options`, run `graph`:
  - host: the functions with the most time of their own in 5000 steps, by Python's profiler. It
    makes callers of many small functions look slower than they are. A wait for the GPU appears as
    time of the function that waits
  - GPU: the kernels of a gradient step of the reward transformer, of 64 segments of 25 steps, and
    of the labelling of 100 000 steps, by torch's profiler

Those of a SAC update are in the table of `sac_gpu.py`.
"""

import argparse
import cProfile
import pstats
import sys
from pathlib import Path

import machine
from codetr_ros.config import load
from codetr_ros.cores import in_process
from codetr_speed import Work
from gpu_runs import RESULTS, Variant, one_run, settings_of, variants
from sac_gpu import device_facts, profiled

TOP = 25


def host(device: str, smallest: bool) -> str:
    """The functions with the most time of their own in a run."""
    variant = next(v for v in variants(device) if (v.group, v.name) == ('options', 'graph'))
    shorter = Variant('', '', variant.changes | {'steps': 5000})
    one_run(shorter, device, smallest=True)  # not counted
    profiler = cProfile.Profile()
    settings = settings_of(shorter, smallest)
    profiler.runcall(in_process.run, settings, 'run')
    entries = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    whole = sum(own for _, _, own, _, _ in entries.values())
    lines = [f'{settings.steps} steps, {whole:.2f} s under the profiler.', '']
    lines += ['| function | calls | own [s] | share | with those it calls [s] |']
    lines += ['|---|---:|---:|---:|---:|']
    longest = sorted(entries.items(), key=lambda item: -item[1][2])[:TOP]
    for (file, line, name), (_, calls, own, cumulative, _) in longest:
        place = f'{Path(file).name}:{line} {name}' if line else name
        place = place.replace('|', '/')
        lines.append(f'| `{place}` | {calls} | {own:.2f} | {own / whole:.0%} | {cumulative:.2f} |')
    return '\n'.join(lines)


def kernels(device: str, smallest: bool, precision: str) -> str:
    """The kernels of a gradient step and of labelling."""
    changes = {'reward_device': device, 'codetr.precision': precision, 'delay': 25}
    changes['codetr.context'] = 'segment'
    changes |= {'codetr.layers': 1, 'codetr.embedding': 16} if smallest else {}
    work = Work(load('paper').changed(changes | {'codetr.label_batch': 4096}))
    work.ids = work.ids[:4000]
    work.gradient(), work.label()
    times = 1 if smallest else 20
    gradient = profiled(lambda: [work.gradient() for _ in range(times)], device, times)
    label = profiled(work.label, device, 1)
    steps = len(work.ids) * 25
    return (
        f'### A gradient step, {precision}\n\n{gradient}\n\n'
        f'### Labelling {steps} steps, {precision}\n\n{label}'
    )


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--device', default='cuda')
    parser.add_argument('--smallest', action='store_true', help='only show that it works')
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    device, smallest = arguments.device, arguments.smallest
    facts = machine.facts(machine.load(), ('torch', 'numpy', 'mujoco')) | device_facts(device)
    lines = ['# What host and GPU do in a run', '']
    lines += [f'- {name}: {value}' for name, value in facts.items()]
    lines += ['', 'What is looked at: `benchmarks/gpu_profile.py`.', '', '## Host', '']
    arguments.out.mkdir(parents=True, exist_ok=True)
    lines += [host(device, smallest), '', '## GPU', '']
    for precision in ('float32', 'bfloat16'):
        lines += [kernels(device, smallest, precision), '']
        (arguments.out / 'profile.md').write_text('\n'.join(lines).rstrip() + '\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
