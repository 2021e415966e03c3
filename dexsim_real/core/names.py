"""A function of the user's that an option names as MODULE:FUNCTION."""

import importlib
from collections.abc import Callable
from typing import Any

from dexsim_real.core.errors import HandError


def find_function(name: str, given: str, form: str, default: str = "") -> Callable[..., Any]:
    """The function; what it raises when it is called is its own.

    Args:
      name: MODULE:FUNCTION, or MODULE for its function `default`.
      given: the option as the user wrote it, for the error.
      form: what to give, for the error.

    Raises:
      HandError: no such module or function, or the module fails when it is imported.
    """
    module, _, function = name.partition(":")
    try:
        return getattr(importlib.import_module(module), function or default)
    except (Exception, SystemExit) as error:  # The module is the user's: importing it may raise anything.
        kind = "" if isinstance(error, (ImportError, AttributeError)) else f"{type(error).__name__}: "
        raise HandError(f"{given}: {kind}{' '.join(str(error).split()):.200}".rstrip(": ") + f"; give {form}") from None
