"""How the library and its extras are installed, for every message that has to say so.

On PyPI the name `dexsim` belongs to another project: nothing here may send a user there.
"""

DISTRIBUTION = "dexsim-xhand"
"""The distribution's name, as in pyproject.toml. The packages are imported as `dexsim`, `dexsim_ppo`, `dexsim_real`."""


def install_line(extra: str) -> str:
    """What a user types to get an extra, from a checkout or a wheel file."""
    return f"pip install -e '.[{extra}]' in the checkout, or pip install '{_WHEEL}[{extra}]'"


_WHEEL = f"./{DISTRIBUTION.replace('-', '_')}-VERSION-py3-none-any.whl"
