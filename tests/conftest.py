"""What the tests share: the CPU unless asked otherwise, a compilation cache, environments.

Set `DEXSIM_TEST_GPU=1` to run on the GPU (`pytest -m gpu` then runs the tests that need one), and
`DEXSIM_CACHE` to keep compiled programs elsewhere than in `~/.cache/dexsim`.
"""

import contextlib
import dataclasses
import functools
import gc
import mmap
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jaxlib

ON_GPU = os.environ.get("DEXSIM_TEST_GPU", "") not in ("", "0")

# Through the environment and before JAX and NumPy are imported: the programs that tests start inherit it.
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # Two threads of one decomposition wait for a core that another process has.
if not ON_GPU:
    os.environ["JAX_PLATFORMS"] = "cpu"
_cache = Path(os.environ.get("DEXSIM_CACHE") or Path.home() / ".cache" / "dexsim")
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(_cache / "xla")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"  # Programs that do not name our lines are made faster.
os.environ.setdefault("MPLBACKEND", "agg")
# Compilation is most of what the suite does, and takes a third of the time without optimisation and by the older
# emitters. The other core has the suite's other process: to split a program for several threads only costs.
XLA_FLAGS = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_force_host_platform_device_count=2",  # for the learner on two devices; all else uses the first
)


def is_known(flag: str) -> bool:
    """Whether XLA has this flag: it ends the process over one that its version does not know."""
    if "fusion_emitters" in flag and jaxlib.version.__version_info__ >= (0, 11, 2):
        return False  # only the name is left in its library
    (library,) = Path(jaxlib.__file__).parent.glob("libjax_common.*")
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        return text.find(flag.strip("-").partition("=")[0].encode()) >= 0


if not ON_GPU and "PYTEST_XDIST_WORKER" not in os.environ:
    flags = os.environ.get("XLA_FLAGS", ""), *filter(is_known, XLA_FLAGS)
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()

gc.set_threshold(200_000, 20, 20)  # Tracing makes millions of objects, hardly any of them in circles.

import hypothesis  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402

from dexsim.core import compilation  # noqa: E402

# Also what the library compiles with options of its own.
compilation.jit = functools.partial(compilation.jit, once=True)

# A shell that starts the suite in the background has it ignore SIGINT, which programs started by tests would inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

hypothesis.settings.register_profile("dexsim", deadline=None, max_examples=20, derandomize=True)
hypothesis.settings.load_profile("dexsim")

# These begin: two processes share the files, and the longest would otherwise be what one of them ends alone with.
LONGEST = """
test_hand_tasks test_shipped_policy test_identification test_docs test_engines test_check_hand test_press_fit
test_procedure test_import_hand test_identify_drives test_env test_shipped_policies test_gymnasium test_learning
test_fine_tune test_motors_off test_notebook test_bridge_run test_mock test_rotate test_controller test_train
test_sharding test_iteration test_true_angles test_c_backend test_randomization
""".split()
# The size of the batch that the tests share. Another batch is another compilation: use this one.
NUM_ENVS = 8


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; skip what is marked `gpu` where there is none."""
    place = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))
    if any("gpu" in item.keywords for item in items) and jax.default_backend() != "gpu":
        skip = pytest.mark.skip(reason="needs a GPU and DEXSIM_TEST_GPU=1")
        for item in items:
            if "gpu" in item.keywords:
                item.add_marker(skip)


# Silent broadcasts and casts between arrays are errors in all tests but these, whose own arithmetic or whose subject
# relies on them. What tests of both kinds share is traced twice.
LENIENT = ("benchmarks", "dexsim/objects/test_object_mesh.py", "dexsim/wrappers/test_brax.py")


@pytest.fixture(autouse=True, scope="module")
def strict_promotion(request: pytest.FixtureRequest) -> Iterator[None]:
    """JAX's strict modes, in all tests but those of `LENIENT`."""
    with contextlib.ExitStack() as modes:
        if not request.path.relative_to(Path(__file__).parent).as_posix().startswith(LENIENT):
            modes.enter_context(jax.numpy_rank_promotion("raise"))
            modes.enter_context(jax.numpy_dtype_promotion("strict"))
        yield


@pytest.fixture(scope="session")
def hand() -> Any:
    """The XHand as shipped."""
    from dexsim.hand.load import load_hand

    return load_hand()


@pytest.fixture(scope="session")
def left() -> Any:
    """Its mirror image."""
    from dexsim.hand.load import load_hand

    return load_hand("xhand_left")


@pytest.fixture(scope="session")
def grasp_env() -> Any:
    """The grasp task on C MuJoCo, with imperfect taxels and a small pool (16 starts of each shape)."""
    import dexsim
    from dexsim.env.config import Sensing
    from dexsim.sensing.taxels import TaxelSensor
    from dexsim.tasks.grasp.config import GraspConfig

    taxels = TaxelSensor(
        resolution=0.0,
        rate=(20.0, 30.0),
        hysteresis=(0.0, 0.1),
        crosstalk=(0.0, 0.05),
        gain=(0.95, 1.05),
        bias=(-0.01, 0.01),
        drift=(0.0, 0.002),
        dead=(0.0, 0.02),
    )
    config = GraspConfig(pool_size=80, release_delay=(0.1, 0.1), sensing=Sensing(taxel=taxels))
    return dexsim.make("grasp", config, backend="c")


@pytest.fixture(scope="session")
def grasp_rollout(grasp_env: Any) -> SimpleNamespace:
    """The grasp task over `NUM_ENVS` environments, objects let go at once: `env`, `reset(key)`, `step(states, actions)`
    and `restart(states, done)`; each compiles at its first use, once."""
    from episodes import ones_of

    restart = compilation.jit(jax.vmap(grasp_env.restart), once=True)
    full = jax.numpy.ones(NUM_ENVS)
    before = ones_of(grasp_env, NUM_ENVS, full)

    def reset(key: jax.Array) -> Any:
        state = restart(dataclasses.replace(before, key=jax.random.split(key, NUM_ENVS)), full > 0)
        return dataclasses.replace(state, goal=dataclasses.replace(state.goal, delay=0.0 * state.goal.delay))

    return SimpleNamespace(env=grasp_env, reset=reset, step=jax.jit(jax.vmap(grasp_env.step)), restart=restart)
