"""The documentation: snippets run, commands have the options that they name, numbers are those of the records."""

import importlib
import json
import re
import shlex
import sys
from pathlib import Path

import pytest
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
    if not argv or "--help" in argv:
        return
    (path,) = {path for path, _ in COMMANDS.values() if path.removesuffix(".__main__") == module}
    (options,) = (kind for name, kind in vars(importlib.import_module(path)).items() if name.endswith("Arguments"))
    default = None
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


def test_links_lead_somewhere():
    """To a file, to one of its headings, from the experiment log's page to a record."""
    known = {record["id"] for name in records.files() for record in records.load(name)}
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")):
        for link, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", page.read_text()):
            target = page.parent / link if link else page
            if "://" in link:
                continue
            assert target.exists(), f"{name_of(page)}: {link}"
            headings = {
                re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-")
                for h in re.findall(r"^#+ (.*)", target.read_text() if anchor else "", re.M)
            }
            if link.endswith("experiments/README.md"):
                headings |= known
            assert anchor in headings | {""}, f"{name_of(page)}: {link}#{anchor}"


def numbers(text: str) -> set[float]:
    return {float(found.replace(",", "")) for found in re.findall(r"\d[\d,]*\.?\d*", text)}


def test_shipped_numbers_are_those_of_their_records():
    """Or an interval of the report that the policy is shipped with."""
    records_by_name, checked = {record["id"]: record for name in records.files() for record in records.load(name)}, 0
    for line in re.findall(r"^\|(.*)\|$", SHIPPED_PAGE, re.M):
        policy, *cells, last = (cell.strip(" `") for cell in line.split("|"))
        found = [records_by_name[name] for name in re.split(r"[^\w-]+", last) if name in records_by_name]
        if not found:
            continue
        stated = numbers(" ".join(cells).replace("120 s", "").replace("8 s", ""))
        report = json.loads((ROOT / "assets" / "policies" / f"{policy}.json").read_text())
        mean = report["trained"]["task"].get("successes", {}).get("mean")
        known = numbers(json.dumps([(r["metrics"], r["seeds"], r["notes"]) for r in found] + [mean]))
        assert stated <= {round(value, digits) for value in known for digits in (0, 1, 2, 3)}, line
        checked += 1
    assert checked > 10


def test_the_readme_has_the_numbers_of_the_shipped_policies():
    """And their intervals. Revolutions are a quarter of the quarter turns, shares and correlations are rounded."""
    readme, means = (ROOT / "README.md").read_text(), {}
    for section in re.split(r"^## ", SHIPPED_PAGE, flags=re.M):
        row = r"^\| `(\w+)` \| [^|]+ \| [^|]+ \| [^|]+ \| ([\d.]+) \| ([\d.]+)–([\d.]+) "
        for policy, *mean in re.findall(row, section, re.M):
            means.setdefault((section.partition("\n")[0], policy), []).extend(map(float, mean))
    table = re.findall(r"^\| `(\w+)`[^|]*\|([^|]+)\|([^|]+)\|", readme, re.M)
    assert [policy for policy, *_ in table] == list(SHIPPED)
    for policy, *cells in table:
        for world, cell in zip(("Simulation", "Emulated hand"), cells, strict=True):
            known = {
                round(mean / part, digits) for mean in means[world, policy] for part in (1, 4) for digits in (0, 2)
            }
            assert numbers(cell) <= known, (policy, world)
    touch = [mean for (section, _), found in means.items() if section == "Touch taken away" for mean in found[::3]]
    words = readme.replace(",", "").replace(".\n", " ").split()
    assert len(touch) == 4 and {f"{mean / 4:.{int(mean < 4)}f}" for mean in touch} <= set(words)
