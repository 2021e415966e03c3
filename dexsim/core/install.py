"""How the library and its extras are installed, for every message that has to say so.

On PyPI the name `dexsim` belongs to another project: nothing here may send a user there.
"""

from importlib.util import find_spec

from dexsim.errors import DexsimError

DISTRIBUTION = "dexsim-xhand"
"""The distribution's name, as in pyproject.toml. The packages are imported as `dexsim`, `dexsim_ppo`, `dexsim_real`."""


def install_line(extra: str) -> str:
    """What a user types to get an extra, from a checkout or a wheel file."""
    return f"pip install -e '.[{extra}]' in the checkout, or pip install '{_WHEEL}[{extra}]'"


def require(module: str, extra: str, purpose: str) -> None:
    """Check that an optional package is installed, without importing it. Raises DexsimError: it is not; says how to
    install the extra."""
    if find_spec(module) is None:
        raise DexsimError(f"{purpose} needs {module}: {install_line(extra)}")


_WHEEL = f"./{DISTRIBUTION.replace('-', '_')}-VERSION-py3-none-any.whl"
