"""Errors that a user can act on: one clear line that says what is wrong and where."""


class DexsimError(Exception):
    """Base of every error raised on purpose. Command-line tools print it and exit with code 2."""

    page = ""
    """The page of the documentation that helps; empty for none."""


class ConfigError(DexsimError):
    """A configuration value is unknown, of the wrong type or out of range."""


class DexsimWarning(UserWarning):
    """Base of every warning. Command-line tools print it as one line."""


class OtherEnvWarning(DexsimWarning):
    """A policy is used in an environment that it was not trained in."""


class AssetError(DexsimError):
    """A model, layout or mesh file is missing, broken or asks for what the library cannot do."""

    page = "docs/troubleshooting.md"


class CheckpointError(DexsimError):
    """A checkpoint or policy file is missing, damaged, of another task or of a newer version."""

    page = "docs/policies.md#the-file"


class CalibrationError(DexsimError):
    """Recorded data cannot answer what is asked of it, or a calibration file cannot be used."""

    page = "docs/calibration.md"
