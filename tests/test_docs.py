"""The documentation: its snippets run, its commands have the options that they name, its log is sound and rendered."""

import json
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from paths import ROOT

from dexsim import registry
from dexsim.core import cli
from dexsim.core.config import from_dict, override
from dexsim_ppo import load_policy

if not (ROOT / "docs").exists():
    pytest.skip("needs a checkout", allow_module_level=True)
sys.path.insert(0, str(ROOT / "docs" / "experiments"))
import render

PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "docs" / "experiments" / "README.md"]
WORDS = {"README.md": 700, "docs/findings.md": 800}
"""Pages with a limit of words."""

COMMANDS = {
    "dexsim_ppo.average": "dexsim_ppo.average:AverageArguments",
    "dexsim_ppo.evaluate": "dexsim_ppo.evaluate:EvaluateArguments",
    "dexsim_ppo.export": "dexsim_ppo.export:ExportArguments",
    "dexsim_ppo.record": "dexsim_ppo.record:RecordArguments",
    "dexsim_ppo.reproduce": "dexsim_ppo.reproduce:ReproduceArguments",
    "dexsim_real.run": "dexsim_real.run.options:RunArguments",
    "dexsim_real.calibrate": "dexsim_real.calibrate.options:CalibrateArguments",
    "dexsim_real.twin": "dexsim_real.twin.options:TwinArguments",
    "dexsim_real.replay": "dexsim_real.replay.__main__:ReplayArguments",
    "dexsim.check_hand": "dexsim.check_hand:CheckHandArguments",
    "dexsim.view": "dexsim.view.__main__:ViewArguments",
    "dexsim.randomization_check": "dexsim.randomization_check.__main__:CheckArguments",
}
"""The commands whose options are one dataclass; those of `dexsim_ppo.train` depend on the task."""


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
        assert module == "dexsim_ppo.train" or module in COMMANDS
    elif module == "dexsim_ppo.train":
        parse_train(argv)
    else:
        home, _, name = COMMANDS[module].partition(":")
        options = cli.parse(getattr(__import__(home, fromlist=[name]), name), argv, prog=module, description="")
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
    from dexsim.__main__ import COMMANDS as names

    _, name, *argv = shlex.split(line)
    test_command_has_its_options(shlex.join(["python", "-m", names[name][0].removesuffix(".__main__"), *argv]))


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


def test_anchors_exist():
    """Links to a heading, or to a record of the log, lead to one."""
    for page in PAGES:
        for link, anchor in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", page.read_text()):
            if "://" in link:
                continue
            text = (page.parent / link if link else page).read_text()
            headings = {
                re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in re.findall(r"^#+ (.*)", text, re.M)
            }
            assert anchor in headings or f'<a id="{anchor}">' in text, f"{name_of(page)}: {link}#{anchor}"


# --- the experiment log ---------------------------------------------------------------------------------


def test_every_record_is_valid_and_named_once():
    assert {path.stem for path in render.HERE.glob("*.jsonl")} == set(render.TABLES)
    ids = [record["id"] for name in render.TABLES for record in render.load(name)]
    assert len(ids) == len(set(ids)) > 300


def test_cited_commits_exist():
    git = ["git", "-C", str(ROOT)]
    whole = subprocess.run([*git, "rev-parse", "--is-shallow-repository"], capture_output=True, text=True)
    if whole.returncode or whole.stdout.strip() != "false":
        pytest.skip("needs a clone with its history")
    cited = sorted(
        {
            commit
            for name in render.TABLES
            for record in render.load(name)
            for commit in re.findall(r"\b[0-9a-f]{7}\b", record["commit"])
        }
    )
    found = subprocess.run([*git, "cat-file", "--batch-check"], input="\n".join(cited), capture_output=True, text=True)
    kinds = {line.split()[0][:7]: line.split()[1] for line in found.stdout.splitlines()}
    assert len(cited) > 60 and not [commit for commit in cited if kinds.get(commit) != "commit"]


@pytest.mark.parametrize("name", render.TABLES)
def test_table_is_up_to_date(name):
    assert (render.HERE / f"{name}.md").read_text() == render.render(name), "run python docs/experiments/render.py"


@pytest.mark.parametrize(
    "change",
    [
        {"id": "Two words"},
        {"date": "23 November 2026"},
        {"commit": "af96a1c with other contacts"},
        {"seeds": ["one"]},
        {"metrics": {"held_pct": None}},
        {"metrics": {"held_pct_ci95": [98.9]}},
        {"verdict": 3},
        {"mood": "good"},
    ],
)
def test_an_unsound_record_is_found(change):
    record = json.loads((render.HERE / "physics.jsonl").read_text().splitlines()[0])
    assert render.check(record) is None
    assert render.check(record | change) is not None
