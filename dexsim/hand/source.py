"""Provenance of a hand, so that what was trained on it is used on the same hand.

A record is plain data: the TOML's name as it was given, a hash of the hand's files, and what its arrays count. None
stands for the shipped default hand.
"""

import contextlib
import warnings
from pathlib import Path
from typing import Any

from dexsim.errors import AssetError, ConfigError, OtherEnvWarning
from dexsim.hand.description import Hand
from dexsim.hand.load import DEFAULT, find_hand, load_hand
from dexsim.hand.mirror import is_mirror_image

Record = dict[str, Any]


def record_of(hand: Hand | None) -> Record | None:
    """What tells this hand from others; None for the default one."""
    return None if hand is None or hand.source == DEFAULT else _record(hand)


def _record(hand: Hand) -> Record:
    return {
        "file": hand.source,
        "digest": hand.digest,
        "joints": list(hand.joint_names),
        "fingers": list(hand.finger_names),
        "taxels": hand.num_taxels,
    }


def check_same(record: Record | None, hand: Hand, what: str) -> None:
    """Whether something recorded is of this hand. Raises ConfigError: it is of another one; `what` names it."""
    before = record or _record(load_hand())
    if before["digest"] != hand.digest:
        changed = ": its files have changed since" if before["file"] == hand.source else ""
        raise ConfigError(f"{what}: expected the hand {before['file']!r:.200}, got {hand.source!r}{changed}")


def recorded_hand(record: Record | None, given: str | Path | None, what: str) -> Hand | None:
    """The hand of something recorded: the `given` one, or the one that the record names; None for the default one.

    Files that were changed since are refused. A given file of the same joints, fingers and taxels is warned of, unless
    it is the recorded hand's mirror image (`dexsim.observation.observe`).

    Raises:
      ConfigError: the hand is another one, or its record is invalid.
      AssetError: its files are missing or broken.
    """
    kinds = {"file": str, "digest": str, "joints": list, "fingers": list, "taxels": int}
    if record is None:
        if not given:
            return None
        record = _record(load_hand())
    elif not isinstance(record, dict) or any(type(record.get(name)) is not kind for name, kind in kinds.items()):
        raise ConfigError(f"invalid record of the hand: {str(record):.80}")
    if not given:
        path = find_hand(record["file"])
        if path.suffix != ".toml" or not path.is_file():  # Nothing else is opened, whatever a policy's file names.
            raise ConfigError(f"{what}: the TOML of its hand {record['file']!r:.200} is missing: give --hand FILE")
        hand = load_hand(record["file"])
        check_same(record, hand, what)
        return hand
    hand = load_hand(given)
    if record["digest"] == hand.digest or _is_mirrored(record, hand):
        return hand
    if record | {"file": "", "digest": ""} != _record(hand) | {"file": "", "digest": ""}:
        check_same(record, hand, what)
    says = f"{what} is of the hand {record['file']!r:.200}, and is used on {hand.source!r}"
    warnings.warn(says, OtherEnvWarning, stacklevel=3)
    return hand


def _is_mirrored(record: Record, hand: Hand) -> bool:
    """Whether a hand is the mirror image of the recorded one; not known where that one's files are missing."""
    with contextlib.suppress(AssetError):
        path = find_hand(record["file"])
        return path.suffix == ".toml" and is_mirror_image(hand, load_hand(path))
    return False
