"""A hand of two fingers, a and b, with one motor and one taxel each, around an MJCF of the test's own."""

TOML = """
model = "two.xml"
taxels = "two.csv"
taxel_grid = [1, 1]
palm = "base"
joints = ["a", "b"]
speed_limits = [8, 8]
[[fingers]]
name = "a"
tip = "a_tip"
root_joint = "a"
[[fingers]]
name = "b"
tip = "b_tip"
root_joint = "b"
"""
HEAD = "finger,column,row,x,y,z,nx,ny,nz,area\n"


def write(folder, mjcf, taxels="a,0,0,0.006,0,0.02,1,0,0,1e-5\nb,0,0,0.006,0,0.02,1,0,0,1e-5\n"):
    """The hand's TOML; its MJCF has bodies from "base" on, joints "a" and "b", sites "a_tip" and "b_tip"."""
    for name, text in (("two.xml", mjcf), ("two.csv", HEAD + taxels), ("two.toml", TOML)):
        (folder / name).write_text(text)
    return folder / "two.toml"
