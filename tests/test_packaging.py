"""The distribution: what importing costs, what the wheel holds, whether an installed copy works."""

import re
import tomllib

import pytest
from paths import ROOT

in_checkout = pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="needs a checkout")


@in_checkout
def test_links_lead_somewhere():
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")):
        links = re.findall(r"\]\(([^)#\s]+)", page.read_text())
        assert not [link for link in links if "://" not in link and not (page.parent / link).exists()], page


def test_no_text_sends_people_to_the_name_of_another_project():
    """`dexsim` on PyPI is not this library. Sources, pages and notebooks install a checkout or a wheel file."""
    folders = ("dexsim", "dexsim_ppo", "dexsim_real", "docs", "notebooks", "benchmarks", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    files += [*ROOT.glob("*.md"), *ROOT.glob("*.toml"), ROOT / "Makefile"]
    text = {path: path.read_text() for path in files if path.suffix in ("", ".py", ".md", ".toml", ".ipynb")}
    assert len(text) > 100
    found = r"""pip3? install[^`\n]*[ \t'"]dexsim(-xhand)?(?=[\s'"`\[=<>)]|$)|['"`]dexsim(-xhand)?\["""
    wrong = [path.name for path, content in text.items() if re.search(found, content, re.MULTILINE)]
    assert wrong == ["pyproject.toml"], "there extras name `train`"


@in_checkout
def test_the_distribution_has_the_name_that_messages_give():
    from dexsim.core.install import DISTRIBUTION, install_line

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == DISTRIBUTION != "dexsim"
    for extra in project["optional-dependencies"]:
        assert re.fullmatch(rf"pip install -e '\.\[{extra}\]' .*\.whl\[{extra}\]'", install_line(extra))
