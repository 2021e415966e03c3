"""Pages of the site that are made from sources: tutorials, experiment log, commands, Python reference, changelog."""

import contextlib
import importlib
import io
import os
import re
import sys
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "experiments"))
import records  # noqa: E402

PACKAGES = ("dexsim", "dexsim_ppo", "dexsim_real")
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md")
"""Pages that lie beside docs/, for readers of the checkout."""


def on_config(config):
    """Every notebook is a tutorial."""
    for entry in config.nav:
        if isinstance(entry, dict) and "Tutorials" in entry:
            entry["Tutorials"] = [f"notebooks/{path.name}" for path in notebooks()]
    return config


def notebooks() -> list[Path]:
    """The quickstart, then the others in the order of their names."""
    return sorted((ROOT / "notebooks").glob("*.ipynb"), key=lambda path: (path.stem != "quickstart", path.stem))


@event_priority(100)  # before the notebooks' plugin, which has to see them
def on_files(files: Files, config) -> Files:
    """Add the pages that lie elsewhere or are made here."""
    made = {"reference/commands.md": commands(), "reference/python.md": python_reference()}
    made |= {name: (ROOT / name).read_text().replace("](docs/", "](") for name in OUTSIDE}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    for notebook in notebooks():
        files.append(File(f"notebooks/{notebook.name}", str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page, **_) -> str:
    """Links that leave docs/ lead to the site's copies; those to other files of the checkout become their names."""
    if page.file.src_uri == "experiments/README.md":
        markdown += "\n" + records.table()
    up = os.path.relpath(".", Path(page.file.src_uri).parent)
    markdown = markdown.replace("](../notebooks/", f"]({up}/notebooks/")
    for name in OUTSIDE:
        markdown = re.sub(rf"\]\((?:\.\./)+{re.escape(name)}", f"]({up}/{name}", markdown)
    return re.sub(r"\[([^\]]+)\]\((?:\.\./)+(?!\w+\.md|experiments|notebooks)[^)]+\)", r"\1", markdown)


def on_page_content(html: str, page, **_) -> str:
    """Links from notebooks into docs/ lead to the site's pages."""
    return (
        re.sub(r'href="\.\./docs/(\w+)\.md"', r'href="../../\1/"', html)
        if page.file.src_uri.startswith("notebooks/")
        else html
    )


def commands() -> str:
    """What each command prints for `--help`."""
    from dexsim.__main__ import COMMANDS

    pages = [
        "# Commands",
        "",
        "`dexsim COMMAND` and `python -m MODULE` are the same. Each takes `--help`.",
    ]
    os.environ["COLUMNS"] = "90"
    for name, (module, purpose) in COMMANDS.items():
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            try:
                importlib.import_module(module).main(["--help"])
            except ModuleNotFoundError:  # ROS 2, which no package index has
                print(importlib.import_module(module).__doc__)
        title = purpose[0].upper() + purpose[1:]
        pages += [
            "",
            f"## {name}",
            "",
            f"{title}: `python -m {module.removesuffix('.__main__')}`.",
            "",
            "```text",
            out.getvalue().strip(),
            "```",
        ]
    return "\n".join(pages) + "\n"


def python_reference() -> str:
    """The public names of each package, from their docstrings."""
    lines = ["# Python", "", "The public names of the three packages."]
    for package in PACKAGES:
        door = importlib.import_module(package)
        lines += ["", f"## {package}", ""]
        for name in door.__all__:
            home = getattr(getattr(door, name), "__module__", package)
            lines += [f"::: {home}.{name}", ""]
    return "\n".join(lines) + "\n"
