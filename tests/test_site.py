"""The documentation site builds without a warning, and its made pages say what the sources say."""

import html
import importlib
import json
import os
import re
import subprocess
import sys

import pytest
from paths import ROOT

pytestmark = pytest.mark.slow
pytest.importorskip("mkdocs_jupyter")
pytest.importorskip("mkdocstrings_handlers.python")
if not (ROOT / "mkdocs.yml").exists():
    pytest.skip("needs a checkout", allow_module_level=True)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site. `--strict` makes an error of every warning: a missing page, a broken link, an unknown name."""
    out = tmp_path_factory.mktemp("site")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        env=environment | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return out


def text_of(site, page):
    return html.unescape(re.sub(r"<[^>]+>", "", (site / page / "index.html").read_text()))


def test_every_public_name_is_in_the_reference(site):
    page = (site / "reference" / "python" / "index.html").read_text()
    for package in ("dexsim", "dexsim_ppo", "dexsim_real"):
        for name in importlib.import_module(package).__all__:
            assert re.search(rf'id="{package}[\w.]*\.{name}"', page), f"{package}.{name}"


def test_the_experiment_log_has_every_record(site):
    page = (site / "experiments" / "index.html").read_text()
    for path in (ROOT / "docs" / "experiments").glob("*.jsonl"):
        for line in path.read_text().splitlines():
            assert f'id="{json.loads(line)["id"]}"' in page


def test_tutorials_and_changelog_are_pages(site):
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        page = site / "notebooks" / notebook.stem / "index.html"
        links = re.findall(r'href="(\.\./[^"#:]+)"', page.read_text())
        assert links and not [link for link in links if not (page.parent / link).exists()]
    assert "Keep a Changelog" in text_of(site, "CHANGELOG")
