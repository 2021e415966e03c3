"""A function of the user's that an option names as MODULE:FUNCTION."""

import importlib
from collections.abc import Callable
from typing import Any

from dexsim_real.core.errors import HandError


def find_function(name: str, given: str, form: str, default: str = "") -> Callable[..., Any]:
    """The function MODULE:FUNCTION, or `default` of MODULE. `given` is the option as written, `form` what to give.

    Raises:
      HandError: no such module or function, or the module fails when it is imported.
    """
    module, _, function = name.partition(":")
    try:
        return getattr(importlib.import_module(module), function or default)
    except (Exception, SystemExit) as error:  # The module is the user's: importing it may raise anything.
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise HandError(f"{given}: {why:.200}; give {form}") from None
