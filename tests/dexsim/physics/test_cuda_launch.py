"""What reaches the CUDA driver from an XLA program, with a driver of our own: no GPU is needed."""

import ctypes
import functools
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.errors import ConfigError
from dexsim.physics import ffi
from dexsim.physics.cuda import launch
from dexsim.physics.cuda.scene import Buffer, Settings, args_type, declare_args

SETTINGS = Settings(substeps=5, iterations=10, line_search=12, tolerance=1e-5, line_search_tolerance=0.25)
BUFFERS = [
    Buffer("qpos", 4),
    Buffer("law_0", 2, ctype="int"),
    Buffer("law_1", 1, ctype="bool"),
    Buffer("qpos_out", 4, output=True),
]
SHARED = 5000


class FakeDriver:
    """Two GPUs that take whatever they are given."""

    def __init__(self):
        self.launches, self.attributes, self.fails = [], {}, ""

    def call(self, name, *arguments):
        if name == self.fails:
            raise RuntimeError(f"backend 'cuda': {name}: out of luck (1)")
        if name == "cuMemcpyDtoH_v2":
            arguments[0]._obj.value = SHARED
        if name == "cuKernelSetAttribute":
            which, value, _, device = arguments
            self.attributes[device, which] = value
        if name == "cuLaunchKernel":
            _, *place, shared, stream, parameters, _ = arguments
            args = args_type(len(BUFFERS)).from_address(parameters[0])
            numbers = [getattr(args, name) for name, *_ in args._fields_[1:]]
            self.launches.append((place, shared, stream.value, list(args.pointers), numbers))

    def attribute(self, which, device):
        return {75: 9, 76: 0, 97: 227 * 1024}[which]


@pytest.fixture
def driver(monkeypatch):
    fake = FakeDriver()
    monkeypatch.setattr(launch, "driver", lambda: fake)
    monkeypatch.setattr(launch, "_local_devices", lambda: [0, 1])
    monkeypatch.setattr(launch, "_kernels", {})
    return fake


def test_a_launch(driver):
    kernel = launch.Kernel(b"code", SETTINGS, len(BUFFERS))
    assert {driver.attributes[device, 8] for device in (0, 1)} == {8 * SHARED}
    kernel.launch(77, 10, [1, 2, 3, 4])
    kernel.launch(77, 0, [1, 2, 3, 4])  # an empty batch is no launch
    ((place, shared, stream, pointers, numbers),) = driver.launches
    assert place == [2, 1, 1, 256, 1, 1] and shared == 8 * SHARED and stream == 77
    assert pointers == [1, 2, 3, 4] and numbers == [10, 5, 10, 12, np.float32(1e-5), 0.25]


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_struct_is_that_of_cpp(tmp_path):
    names = [buffer.name for buffer in BUFFERS] + [name for name, *_ in args_type(1)._fields_[1:]]
    offsets = ", ".join(f"offsetof(Args, {name})" for name in names)
    source = tmp_path / "args.cpp"
    source.write_text(
        f"#include <cstddef>\n#include <cstdio>\n{declare_args(BUFFERS)}\n"
        f'int main() {{ const size_t all[] = {{sizeof(Args), {offsets}}}; for (size_t x : all) printf("%zu ", x); }}'
    )
    subprocess.run(["g++", source, "-o", tmp_path / "args"], check=True)
    size, *there = map(int, subprocess.check_output(tmp_path / "args").split())
    args = args_type(len(BUFFERS))
    pointers = [8 * index for index in range(len(BUFFERS))]
    assert there == pointers + [getattr(args, name).offset for name, *_ in args._fields_[1:]]
    assert size == ctypes.sizeof(args)


def test_what_a_machine_lacks_is_named(driver, monkeypatch):
    monkeypatch.setattr(driver, "attribute", lambda which, device: 39_999)
    with pytest.raises(ConfigError, match="8 worlds need 40000 bytes of shared memory, of which GPU 0 .* 39999"):
        launch.Kernel(b"code", SETTINGS, len(BUFFERS))
    monkeypatch.setattr(driver, "attribute", lambda which, device: 8 + device)
    with pytest.raises(ConfigError, match="not of sm_88, sm_99: choose with CUDA_VISIBLE_DEVICES"):
        launch.architecture.__wrapped__()
    monkeypatch.setattr(ctypes, "CDLL", lambda name: (_ for _ in ()).throw(OSError(name)))
    with pytest.raises(ConfigError, match="needs NVIDIA's driver, with libcuda.so.1"):
        launch.Driver()


class Call:
    """A call as XLA makes it: a frame with arrays on an imagined device."""

    def __init__(self, kernel, arguments, results, stage=3):
        self.kept, self.errors = [], []
        stream = self.keep(ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(self.stream))
        error = self.keep(ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(self.error))
        api = self.keep(ffi._Api())
        api.get_stream, api.create_error = (ctypes.cast(f, ctypes.c_void_p).value for f in (stream, error))
        frame = self.frame = ffi.Frame(api=ctypes.pointer(api), stage=stage)
        frame.arguments, frame.results = self.buffers(arguments), self.buffers(results)
        spans = [self.keep(self.span(text)) for text in (b"kernel", kernel.encode())]
        frame.attributes.size = 1
        frame.attributes.types = self.keep((ctypes.c_int * 1)(4))
        frame.attributes.names, frame.attributes.items = (
            self.keep((ctypes.c_void_p * 1)(ctypes.addressof(span))) for span in spans
        )

    def keep(self, value):
        self.kept.append(value)
        return value

    def span(self, text):
        memory = self.keep(ctypes.create_string_buffer(text))
        return ffi._Span(ctypes.addressof(memory), len(text))

    def buffers(self, arrays):
        made = []
        for address, shape in arrays:
            dims = self.keep((ctypes.c_int64 * len(shape))(*shape))
            made.append(self.keep(ffi.Buffer(data=address, rank=len(shape), dims=dims)))
        items = self.keep((ctypes.c_void_p * len(made))(*map(ctypes.addressof, made)))
        return ffi.Buffers(size=len(made), items=items)

    def stream(self, address):
        ffi._StreamArguments.from_address(address).stream = 55

    def error(self, address):
        self.errors.append(ffi._ErrorArguments.from_address(address).message.decode())
        return 1

    def answer(self):
        return ffi._answer(launch._serve, launch.TRAITS, ctypes.addressof(self.frame))


@pytest.mark.parametrize(("batch", "worlds"), [((), 1), ((13,), 13), ((2, 3, 5), 30)])
def test_a_call_of_xlas_is_one_launch(driver, batch, worlds):
    name = launch.load(b"code", SETTINGS, len(BUFFERS))
    arguments = [(100, (*batch, 4)), (200, (*batch, 2)), (300, batch)]
    assert Call(name, arguments, [(400, (*batch, 4))]).answer() is None
    ((place, _, stream, pointers, numbers),) = driver.launches
    assert place[0] == -(-worlds // 8) and numbers[0] == worlds
    assert stream == 55 and pointers == [100, 200, 300, 400]


def test_errors_are_xlas(driver):
    name = launch.load(b"code", SETTINGS, len(BUFFERS))
    arrays = [(100, (4,))] * 3, [(400, (4,))]
    driver.fails = "cuLaunchKernel"
    for kernel, message in ((name, "cuLaunchKernel: out of luck"), ("unknown", "has not made the environment")):
        call = Call(kernel, *arrays)
        assert call.answer() == 1 and message in call.errors[0].splitlines()[0]
    assert Call(name, *arrays, stage=0).answer() is None, "only what is executed is launched"


def test_xla_learns_that_launches_can_be_recorded(driver):
    call = Call("", [], [])
    metadata = ffi._Metadata()
    request = ffi._MetadataRequest(type=1, metadata=ctypes.pointer(metadata))
    call.frame.extension = ctypes.addressof(request)
    assert call.answer() is None
    assert metadata.traits == 1 and not driver.launches


def tick(name, qpos, count, flag):
    return launch.call(name, [jax.ShapeDtypeStruct((4,), jnp.float32)], qpos, count, flag)


def test_a_batch_of_batches_is_one_call():
    """What is the same for all worlds is repeated: the kernel reads a row for each."""
    one = functools.partial(tick, "name")
    both = jax.vmap(jax.vmap(one, in_axes=(0, None, None)), in_axes=(0, 0, None))
    given = jnp.zeros((3, 5, 4)), jnp.zeros((3, 2), jnp.int32), jnp.array(True)
    text = jax.jit(both).trace(*given).lower(lowering_platforms=("cuda",)).as_text()
    (call,) = [line for line in text.splitlines() if "custom_call" in line]
    assert "@dexsim_cuda" in call and 'kernel = "name"' in call
    assert "(tensor<3x5x4xf32>, tensor<3x5x2xi32>, tensor<3x5xi1>) -> tensor<3x5x4xf32>" in call
