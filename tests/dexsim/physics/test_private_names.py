"""What we use of MJX that it does not document: a new version may move it without a word."""

import ast
from pathlib import Path

import mujoco
from mujoco import mjx

from dexsim.physics import mjx_backend

DATA = {"contact", "efc_D", "efc_J", "efc_aref", "efc_force", "efc_frictionloss", "ne", "nf"}
CONTACT = {"dim", "dist", "efc_address", "frame", "friction", "geom", "includemargin"}


def used(source: str, *owners: str) -> set[str]:
    """Attributes taken from expressions or variables with these texts."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Attribute)]
    return {node.attr for node in nodes if ast.unparse(node.value) in owners}


def test_the_private_names_of_mjx_exist_and_are_all_listed():
    source = Path(mjx_backend.__file__).read_text()
    assert used(source, "data._impl", "rows") == DATA
    assert used(source, "touch", "contact") == CONTACT
    sphere = '<body><freejoint/><geom size=".1"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{sphere}</worldbody></mujoco>'
    )
    private = mjx.make_data(mjx.put_model(model))._impl
    assert [name for name in DATA if not hasattr(private, name)] == []
    assert [name for name in CONTACT if not hasattr(private.contact, name)] == []
