"""Calls of the host from compiled programs, each in a process of its own: two cores, Ctrl-C, and cached programs."""

import json
import os
import signal
import subprocess
import sys

import pytest
from paths import ROOT

pytestmark = [pytest.mark.slow]  # half a minute each on a busy machine

PROGRAM = """
import json, os, sys, time
import jax, jax.numpy as jnp, numpy as np
import dexsim
from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.objects.params import sample_object
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.physics import Physics
from dexsim.physics.interface import PhysicsState

mode, count = sys.argv[1], int(sys.argv[2])
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if name.endswith("/cache_hits") else None)
hand, largest = dexsim.load_hand(), ObjectConfig().largest
physics = Physics(hand, SLOTS, largest, PhysicsConfig(), gravity=(-9.81, 0, 0), backend="c")
target = jax.jit(lambda keys: jax.vmap(lambda key: sample_object(key, ObjectConfig()))(keys))(
    jax.random.split(jax.random.key(0), count)
)
qpos = jnp.tile(jnp.array([0.0] * 12 + [0.08, 0.0, 0.08, 1.0, 0.0, 0.0, 0.0]), (count, 1))
state = PhysicsState(qpos, jnp.zeros((count, 18)), jnp.zeros((count, 18)))

def hold(index, position, velocity):
    return 2.0 * (0.6 - position) - 0.1 * velocity

def ticks(state):
    def body(state, _):
        after, force = jax.vmap(lambda t, s: physics.advance(hold, t, s, jnp.zeros(3)))(target, state)
        # Work for XLA's own threads between the calls.
        return after, jnp.sum(jnp.sin(jnp.ones((300, 300)) @ jnp.ones((300, 300)))) + jnp.sum(force)
    return jax.lax.scan(body, state, length=10)

ticks = jax.jit(ticks)
"""
BUSY = (
    PROGRAM
    + """
flights = [jax.tree.map(lambda x, i=i: x.at[:].add(0.001 * i), state) for i in range(4)]
for _ in range(6):
    flights = [ticks(state)[0] for state in flights]
jax.block_until_ready(flights)
print(json.dumps(len(os.sched_getaffinity(0))))
"""
)
LONG = (
    PROGRAM
    + """
state = ticks(state)[0]
jax.block_until_ready(state)
try:
    print("running", flush=True)  # From here on a signal must be caught.
    while True:
        state = ticks(state)[0]
        jax.block_until_ready(state)
except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
    print("stopped", type(error).__name__, flush=True)
"""
)
CACHED = (
    PROGRAM
    + """
hits.clear()
after, _ = ticks(state)
print(json.dumps([len(hits), np.asarray(after.qpos).tobytes().hex()]))
"""
)


def start(program, *arguments, **environment):
    variables = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"} | environment
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env=variables,
        cwd=ROOT,
    )


@pytest.mark.parametrize("cores", [1, 2])
def test_programs_in_flight_do_not_block_each_other(cores):
    """With asynchronous dispatch, as many programs as fit wait for the host on few cores."""
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("the system cannot bind a process to cores")
    mine = sorted(os.sched_getaffinity(0))[:cores]
    process = start(f"import os; os.sched_setaffinity(0, {set(mine)})\n{BUSY}", "busy", 64)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0 and json.loads(out) == len(mine)


def test_ctrl_c_while_the_pool_runs():
    process = start(LONG, "long", 64)
    assert process.stdout.readline() == "running\n"
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert out.startswith("stopped") and process.returncode == 0


def test_programs_are_cached(tmp_path):
    """A second process takes the program from JAX's cache, and it finds this process's engine."""
    options = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    runs = []
    for _ in range(2):
        process = start(CACHED, "cached", 4, **options)
        out, _ = process.communicate(timeout=120)
        assert process.returncode == 0
        runs.append(json.loads(out))
    assert runs[0][0] == 0 and runs[1][0] > 0
    assert runs[0][1] == runs[1][1]
