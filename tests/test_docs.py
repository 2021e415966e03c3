"""The documentation: snippets run, commands have the options that they name, numbers are those of the records."""

import json
import pkgutil
import re
import shlex
import sys
from pathlib import Path

import pytest
from option_classes import OPTIONS
from paths import ROOT

from dexsim import registry
from dexsim.__main__ import COMMANDS
from dexsim.core import cli
from dexsim.core.config import from_dict, override
from dexsim.geometry import grid
from dexsim_ppo import load_policy
from dexsim_ppo.training.presets import preset_arguments

if not (ROOT / "docs").exists():
    pytest.skip("needs a checkout", allow_module_level=True)
sys.path.insert(0, str(ROOT / "docs" / "experiments"))
import records

SHIPPED = ("grasp", "rotate", "rotate_without_orientation", "rotate_clear")
SHIPPED_PAGE = (ROOT / "docs" / "shipped.md").read_text()
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "docs" / "experiments" / "README.md"]
USER_WORDS = 15_000
"""Limit of all pages for users: README and docs/*.md."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def snippets():
    """Python blocks of all pages; `<!-- not run: why -->` directly before a block leaves it out."""
    for page in PAGES:
        text = page.read_text()
        for found in re.finditer(r"(<!-- not run: [^>]+ -->\n)?```python\n(.*?)```", text, re.DOTALL):
            if not found[1]:
                marks = [pytest.mark.slow] if "GymVectorEnv" in found[2] else []  # compiles the task once more
                line = text[: found.start()].count("\n") + 1
                yield pytest.param(found[2], id=f"{name_of(page)}:{line}", marks=marks)


def runnable(page: Path) -> str:
    """A page without blocks after `<!-- not run: why -->`, each command in one line."""
    text = re.sub(r"<!-- not run: [^>]+ -->\n```\n.*?```", "", page.read_text(), flags=re.DOTALL)
    return text.replace("\\\n", " ")


def commands(page: Path):
    """Module and arguments of a page's commands: `python -m dexsim...` anywhere, `dexsim word ...` in blocks."""
    for line in re.findall(r"python -m dexsim[^`\n#]*", runnable(page)):
        _, _, module, *argv = shlex.split(line)
        yield module.rstrip(".,"), argv
    for block in re.findall(r"^```\n(.*?)^```", runnable(page), re.DOTALL | re.MULTILINE):
        for line in re.findall(r"^dexsim [^#\n]*", block, re.MULTILINE):
            _, word, *argv = shlex.split(line)
            yield COMMANDS[word][0].removesuffix(".__main__"), argv


@pytest.mark.parametrize("code", list(snippets()))
def test_snippet_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    monkeypatch.setitem(grid.bake.__kwdefaults__, "nodes", 24)  # 64 take twenty times as long to measure
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})


def check_command(module, argv):
    """Every option exists and takes the value; a shipped policy's configuration has what `--set` changes."""
    options, default = pkgutil.resolve_name(OPTIONS[module][0]), None
    if not argv or "--help" in argv:
        return
    if module == "dexsim_ppo.train":
        task = argv[argv.index("--task") + 1] if "--task" in argv else "grasp"
        entry = registry.find_task(task)
        options, default = options[entry.config_class], preset_arguments(task, entry.config(), "cpu")
    given = cli.parse(options, argv, prog=module, description="", default=default)
    if getattr(given, "set", None):
        policy = load_policy(given.policy)
        config = from_dict(registry.find_task(policy.task).config_class, policy.env_config)
        override(config, list(given.set))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_have_their_options(page):
    for module, argv in commands(page):
        try:
            check_command(module, argv)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"{name_of(page)}: {module} {shlex.join(argv)}") from error
    for line in re.findall(r"python benchmarks/[^`\n#]*", runnable(page)):
        _, script, *argv = shlex.split(line)
        source = (ROOT / script).read_text()
        for option in (word.removeprefix("--") for word in argv if word.startswith("--")):
            assert re.search(rf"\b{option}\b|\b{option.replace('-', '_')}\b", source), f"{script} has no --{option}"


def test_the_user_pages_are_short():
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md")]
    assert sum(len(page.read_text().split()) for page in pages) <= USER_WORDS


def test_anchors_exist():
    """Links to a heading lead to one, links to the experiment log to a record."""
    known = {record["id"] for name in records.files() for record in records.load(name)}
    for page in PAGES:
        for link, anchor in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", page.read_text()):
            if "://" in link:
                continue
            text = (page.parent / link if link else page).read_text()
            headings = {
                re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in re.findall(r"^#+ (.*)", text, re.M)
            }
            if link.endswith("experiments/README.md"):
                headings |= known
            assert anchor in headings, f"{name_of(page)}: {link}#{anchor}"


def numbers(text: str) -> set[float]:
    return {float(found.replace(",", "")) for found in re.findall(r"\d[\d,]*\.?\d*", text)}


def shipped_rows():
    """Rows of docs/shipped.md that name a record: what they state, and the record."""
    known = {record["id"]: record for name in records.files() for record in records.load(name)}
    for line in (ROOT / "docs" / "shipped.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and (names := [name for name in re.findall(r"`([^`]+)`", cells[-1]) if name in known]):
            yield cells[:-1], [known[name] for name in names]


def test_shipped_numbers_are_those_of_their_records():
    """Or an interval of the report that the policy is shipped with."""
    rows = list(shipped_rows())
    assert len(rows) > 10
    for cells, found in rows:
        stated = numbers(" ".join(cells[1:]).replace("120 s", "").replace("8 s", ""))
        report = json.loads((ROOT / "assets" / "policies" / f"{cells[0].strip('`')}.json").read_text())
        mean = report["trained"]["task"].get("successes", {}).get("mean")
        known = numbers(json.dumps([(r["metrics"], r["seeds"], r["notes"]) for r in found] + [mean]))
        assert stated <= {round(value, digits) for value in known for digits in (0, 1, 2, 3)}, cells


def test_the_readme_has_the_numbers_of_the_shipped_policies():
    """Revolutions are a quarter of the quarter turns, shares and correlations are rounded."""
    rows = {}
    for section in re.findall(r"^## (Simulation|Emulated hand)\n(.*?)(?=^## )", SHIPPED_PAGE, re.M | re.S):
        for policy, measure, mean in re.findall(
            r"^\| `(\w+)` \| [^|]+ \| [^|]+ \| ([^|]+) \| ([\d.]+) ", section[1], re.M
        ):
            rows[section[0], policy, measure.split()[0]] = float(mean)
    readme = (ROOT / "README.md").read_text()
    table = {name: cells for name, cells in re.findall(r"^\| `(\w+)`[^|]*\|(.*)\|$", readme, re.M)}
    assert set(table) == set(SHIPPED)
    for (world, policy, measure), mean in rows.items():
        cell = table[policy].split("|")[world == "Emulated hand"]
        if measure == "quarter":
            assert re.search(rf"\b{mean / 4:.0f}\b", cell)
        elif (policy, measure) == ("grasp", "held"):
            assert f"{mean:.0f} % held" in cell
        elif (policy, measure) == ("grasp", "force") and mean > 0.8:  # The other row is the error, in newtons.
            assert f"r {mean:.2f}" in cell
    touch = SHIPPED_PAGE.partition("## Touch taken away")[2]
    means = re.findall(r"^\| `\w+` \| [^|]+ \| [^|]+ \| [^|]+ \| ([\d.]+) ", touch, re.M)
    assert len(means) == 4 and all(f" {mean} " in readme.replace(".\n", " ") for mean in means)


def test_result_cells_are_those_of_the_tables():
    """A number with its range on the page of results is a cell of the table that the report makes."""
    tables = "".join(path.read_text() for path in (ROOT / "docs" / "results").glob("*/table.md"))
    cells = re.findall(r"[\d.]+ \([\d.]+–[\d.]+\)", (ROOT / "docs" / "results.md").read_text())
    assert len(cells) > 30 and not [cell for cell in cells if cell not in tables]
