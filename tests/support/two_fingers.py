"""A hand of two fingers, a and b, with one motor and one taxel each, around an MJCF of the test's own."""

import shutil

from paths import DATA

HEAD = "finger,column,row,x,y,z,nx,ny,nz,area\n"


def write(folder, mjcf, taxels="a,0,0,0.006,0,0.02,1,0,0,1e-5\nb,0,0,0.006,0,0.02,1,0,0,1e-5\n"):
    """The hand's TOML; its MJCF has bodies from "base" on, joints "a" and "b", sites "a_tip" and "b_tip"."""
    (folder / "two.xml").write_text(mjcf)
    (folder / "two.csv").write_text(HEAD + taxels)
    return shutil.copy(DATA / "two.toml", folder)
