"""Starts a command in several processes of this host as Slurm would, each with its share of the cores and GPUs.

    python benchmarks/launch.py 2 -- python -m dexsim_ppo.train --task grasp --devices 0 --run-dir runs/two

Says the process ids, and ends with the first exit code that is not 0.
"""

import argparse
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from typing import Any


def start(command: Sequence[str], number: int, *, joined: bool = True, **options: Any) -> list[subprocess.Popen]:
    """The processes; those that are not `joined` know nothing of each other. `options` are those of `Popen`."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    job = {"SLURM_JOB_ID": "1", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": str(number)}
    gpus, cores, found = gpu_names(), sorted(os.sched_getaffinity(0)), []
    for index in range(number):
        environment = dict(os.environ)
        if joined:
            environment |= job | {"JAX_COORDINATOR_PORT": port}
            environment |= {"SLURM_PROCID": str(index), "SLURM_LOCALID": str(index)}
        if gpus:
            mine = share(gpus, index, number)
            environment["CUDA_VISIBLE_DEVICES"] = ",".join(mine)
            environment["JAX_LOCAL_DEVICE_IDS"] = ",".join(map(str, range(len(mine))))
        pinned = share(cores, index, number)
        found.append(
            subprocess.Popen(
                list(command),
                env=environment,
                preexec_fn=lambda pinned=pinned: os.sched_setaffinity(0, pinned),
                **options,
            )
        )
    return found


def share(things: list, index: int, number: int) -> list:
    """What one of the processes gets: equal runs, or all if there are fewer things than processes."""
    each = len(things) // number
    return things[index * each : (index + 1) * each] or things


def gpu_names() -> list[str]:
    """The GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    if "CUDA_VISIBLE_DEVICES" in os.environ:
        return [name for name in os.environ["CUDA_VISIBLE_DEVICES"].split(",") if name]
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return []
    return [str(index) for index, line in enumerate(listed.splitlines()) if line.startswith("GPU ")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("number", type=int, help="processes")
    parser.add_argument("command", nargs="+", help="after --")
    options = parser.parse_args()
    running = start(options.command, options.number)
    for index, process in enumerate(running):
        print(f"process {index}: pid {process.pid}", file=sys.stderr, flush=True)
    try:
        codes = [process.wait() for process in running]
    except KeyboardInterrupt:  # The terminal has sent it to all of them.
        codes = [process.wait() for process in running]
    return next((code if code > 0 else 128 - code for code in codes if code), 0)


if __name__ == "__main__":
    sys.exit(main())
