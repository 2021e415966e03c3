"""Errors that a user can act on, and warnings; see `dexsim.core.errors`."""

from dexsim.core.errors import (
    AssetError as AssetError,
    CalibrationError as CalibrationError,
    CheckpointError as CheckpointError,
    ConfigError as ConfigError,
    DexsimError as DexsimError,
    DexsimWarning as DexsimWarning,
    OtherEnvWarning as OtherEnvWarning,
)
