"""Errors that a user can act on, and warnings; see `dexsim.core.errors`."""

from dexsim.core.errors import AssetError as AssetError
from dexsim.core.errors import CalibrationError as CalibrationError
from dexsim.core.errors import CheckpointError as CheckpointError
from dexsim.core.errors import ConfigError as ConfigError
from dexsim.core.errors import DexsimError as DexsimError
from dexsim.core.errors import DexsimWarning as DexsimWarning
from dexsim.core.errors import OtherEnvWarning as OtherEnvWarning
