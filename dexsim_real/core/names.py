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
      HandError: no such module or function, it is no function, or the module fails when it is imported.
    """
    module, _, function = name.partition(":")
    try:
        function_object = getattr(importlib.import_module(module), function or default)
    except (Exception, SystemExit) as error:  # The module is the user's: importing it may raise anything.
        says = " ".join(str(error).split())
        if not isinstance(error, (ImportError, AttributeError)):
            says = f"{type(error).__name__}: {says}".removesuffix(": ")
        raise HandError(f"{given}: {says:.200}; give {form}") from None
    if not callable(function_object):
        raise HandError(f"{given}: {function or default} is no function; give {form}")
    return function_object
