"""Errors that a user can act on, and warnings."""

from dexsim.core.errors import (
    AssetError,
    CalibrationError,
    CheckpointError,
    ConfigError,
    DexsimError,
    DexsimWarning,
    OldFileWarning,
    OtherEnvWarning,
)

__all__ = [
    "AssetError",
    "CalibrationError",
    "CheckpointError",
    "ConfigError",
    "DexsimError",
    "DexsimWarning",
    "OldFileWarning",
    "OtherEnvWarning",
]
