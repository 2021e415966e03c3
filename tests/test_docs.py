"""The documentation: snippets run, commands have the options that they name, numbers are those of the records."""

import dataclasses
import json
import pkgutil
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
from option_classes import OPTIONS
from paths import ROOT

from dexsim import registry
from dexsim.core import cli
from dexsim.core.config import from_dict, override
from dexsim.env.task import GroundTruth
from dexsim_ppo import load_policy

if not (ROOT / "docs").exists():
    pytest.skip("needs a checkout", allow_module_level=True)
sys.path.insert(0, str(ROOT / "docs" / "experiments"))
import records

SHIPPED = ("grasp", "rotate", "rotate_without_orientation", "rotate_clear")
SHIPPED_PAGE = (ROOT / "docs" / "shipped.md").read_text()
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "docs" / "experiments" / "README.md"]
WORDS = {"README.md": 350, "CHANGELOG.md": 1000}
"""Pages with a limit of words."""
USER_WORDS = 15_000
"""Limit of all pages for users: README and docs/*.md."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def snippets():
    """Python blocks of all pages; `<!-- not run: why -->` directly before a block leaves it out."""
    for page in PAGES:
        for found in re.finditer(r"(<!-- not run: [^>]+ -->\n)?```python\n(.*?)```", page.read_text(), re.DOTALL):
            if not found[1]:
                yield pytest.param(
                    found[2], id=f"{name_of(page)}:{page.read_text()[: found.start()].count(chr(10)) + 1}"
                )


def commands(start: str):
    """Shell commands of all pages that begin with `start`, in blocks or inline, up to a comment; not those of a block
    after `<!-- not run: why -->`."""
    for page in PAGES:
        text = re.sub(r"<!-- not run: [^>]+ -->\n```\n.*?```", "", page.read_text(), flags=re.DOTALL).replace(
            "\\\n", " "
        )
        for found in re.finditer(rf"{re.escape(start)}[^`\n#]*", text):
            yield pytest.param(found[0].strip(), id=f"{name_of(page)}: {found[0].strip()}")


@pytest.mark.parametrize("code", list(snippets()))
def test_snippet_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})


@pytest.mark.parametrize("line", list(commands("python -m dexsim")))
def test_command_has_its_options(line):
    """Every option exists and takes the value; a shipped policy's configuration has what `--set` changes."""
    module, *argv = shlex.split(line)[2:]
    module = module.rstrip(".,")
    if not argv or "--help" in argv:
        assert module in OPTIONS
    elif module == "dexsim_ppo.train":
        parse_train(argv)
    else:
        options = cli.parse(pkgutil.resolve_name(OPTIONS[module][0]), argv, prog=module, description="")
        if getattr(options, "set", None):
            policy = load_policy(options.policy)
            config = from_dict(registry.find_task(policy.task).config_class, policy.env_config)
            override(config, list(options.set))


def console_lines():
    """Lines of code blocks that begin with the console command."""
    for page in PAGES:
        for block in re.findall(r"^```\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            for line in re.findall(r"^dexsim [^#\n]*", block, re.MULTILINE):
                yield pytest.param(line.strip(), id=f"{name_of(page)}: {line.strip()}")


@pytest.mark.parametrize("line", list(console_lines()))
def test_console_command_exists(line):
    from dexsim.__main__ import COMMANDS

    _, name, *argv = shlex.split(line)
    test_command_has_its_options(shlex.join(["python", "-m", COMMANDS[name][0].removesuffix(".__main__"), *argv]))


def parse_train(argv: list[str]) -> None:
    from dexsim_ppo import train
    from dexsim_ppo.training.presets import preset_arguments

    task = argv[argv.index("--task") + 1] if "--task" in argv else "grasp"
    entry = registry.find_task(task)
    default = preset_arguments(task, entry.config(), "cpu")
    cli.parse(train.TrainArguments[entry.config_class], argv, prog="train", description="", default=default)


@pytest.mark.parametrize("line", list(commands("python benchmarks/")))
def test_benchmark_has_its_options(line):
    _, script, *argv = shlex.split(line)
    source = (ROOT / script).read_text()
    for option in (word.removeprefix("--") for word in argv if word.startswith("--")):
        assert re.search(rf"\b{option}\b|\b{option.replace('-', '_')}\b", source), f"{script} has no --{option}"


def test_extras_and_targets_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in PAGES:
        text = page.read_text()
        for names in re.findall(r"pip install [^`\n]*?\[([\w,]+)\]", text):
            assert set(names.split(",")) <= set(extras), f"{name_of(page)}: {names}"
        for line in re.findall(r"^make [^#\n]*", text, re.MULTILINE):
            assert next(word for word in shlex.split(line)[1:] if "=" not in word) in targets, (
                f"{name_of(page)}: {line}"
            )


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_names_in_the_text_exist(page):
    """Paths of the checkout, and dotted names of the packages, that a page mentions in backquotes."""
    if page.name == "CHANGELOG.md":
        return  # It names what is gone.
    for name in re.findall(
        r"`((?:dexsim|dexsim_ppo|dexsim_real|tests|benchmarks|docs|assets)/[\w./-]+)`", page.read_text()
    ):
        assert (ROOT / name).exists(), f"{name_of(page)}: {name}"
    for name in re.findall(r"`((?:dexsim|dexsim_ppo|dexsim_real)(?:\.\w+)+)[`(]", page.read_text()):
        assert resolves(name), f"{name_of(page)}: {name}"


def resolves(name: str) -> bool:
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.mark.parametrize("page", WORDS)
def test_page_is_short(page):
    assert len((ROOT / page).read_text().split()) <= WORDS[page]


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


def test_an_own_task_page_lists_all_of_the_ground_truth():
    page = (ROOT / "docs" / "your_own_task.md").read_text()
    named = {name.split(".")[0] for name in re.findall(r"`([a-z_.]+)`", page)}
    assert {field.name for field in dataclasses.fields(GroundTruth)} <= named


# --- numbers --------------------------------------------------------------------------------------------


def numbers(text: str) -> set[float]:
    return {float(found.replace(",", "")) for found in re.findall(r"\d[\d,]*\.?\d*", text)}


def shipped_rows():
    """Rows of docs/shipped.md that name a record: what they state, and the record."""
    known = {record["id"]: record for name in records.files() for record in records.load(name)}
    for line in (ROOT / "docs" / "shipped.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and (names := [name for name in re.findall(r"`([^`]+)`", cells[-1]) if name in known]):
            yield pytest.param(cells[:-1], [known[name] for name in names], id=f"{names[0]} {cells[3]}")


@pytest.mark.parametrize("cells, found", list(shipped_rows()))
def test_a_shipped_number_is_that_of_its_record(cells, found):
    """Or an interval of the report that the policy is shipped with."""
    stated = numbers(" ".join(cells[1:]).replace("120 s", "").replace("8 s", ""))
    report = json.loads((ROOT / "assets" / "policies" / f"{cells[0].strip('`')}.json").read_text())["trained"]["task"]
    known = numbers(
        json.dumps([(r["metrics"], r["seeds"], r["notes"]) for r in found] + [report.get("successes", {}).get("mean")])
    )
    assert stated <= {round(value, digits) for value in known for digits in (0, 1, 2, 3)}


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
    assert len(cells) > 40 and not [cell for cell in cells if cell not in tables]


# --- the experiment log ---------------------------------------------------------------------------------


def test_every_record_is_valid_and_named_once():
    ids = [record["id"] for name in records.files() for record in records.load(name)]
    assert len(ids) == len(set(ids)) > 300
