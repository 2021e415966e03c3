"""The paper's tables and figures: all of them with a tiny budget, what is resumed, and what the rows consist of."""

import importlib
import json
from types import SimpleNamespace

import pytest
from paths import ROOT

pytest.importorskip("serial")
RESULTS = ROOT / "docs" / "results"
if not RESULTS.exists():
    pytest.skip("needs a checkout", allow_module_level=True)


@pytest.fixture(scope="module")
def paper():
    """The package's modules by name."""
    with pytest.MonkeyPatch.context() as patch:
        # The flags that other tests compile with stay as they are.
        patch.setattr("dexsim_real.control.controller.prepare_jax", lambda: None)
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        names = ("command", "data", "experiments", "held_out", "measure", "tables")
        yield SimpleNamespace(**{name: importlib.import_module(f"paper.{name}") for name in names})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["readings", "all"])
def test_smoke(paper, tmp_path, monkeypatch, name):
    """Every row has a report, every experiment its table or figures; another run has nothing to do."""
    monkeypatch.chdir(tmp_path)  # where trainings are kept as well
    output = tmp_path / "reports"
    assert paper.command.main([name, "--budget", "smoke", "--output", str(output)]) == 0
    for experiment in [known for known in paper.experiments.EXPERIMENTS.values() if name in ("all", known.name)]:
        for row in experiment.rows:
            report = json.loads(paper.data.report_path(output, experiment, row).read_text())
            assert report["budget"] == "smoke" and set(report["seeds"]) == {"0"}
        written = [path.suffix for path in (output / experiment.name).rglob("*")]
        assert (".svg" in written) == (experiment.draw is not None) and ".md" in written
    again = {path: path.stat().st_mtime_ns for path in output.rglob("report.json")}
    paper.command.main([name, "--budget", "smoke", "--output", str(output)])
    assert again == {path: path.stat().st_mtime_ns for path in output.rglob("report.json")}


def test_settings_of_all_rows_are_of_their_tasks(paper):
    """What would otherwise fail after an hour: a field's name, a value out of range, a field that is not observed."""
    from dexsim.core.config import from_dict, override, to_dict
    from dexsim.registry import find_task
    from dexsim_ppo import load_policy

    for experiment in paper.experiments.EXPERIMENTS.values():
        assert len({row.name for row in experiment.rows}) == len(experiment.rows)
        for row in experiment.rows:
            if row.points:
                entry, policy = find_task(row.task), load_policy(row.policy)
                settings = [[setting.format(point, point) for setting in row.settings] for point in row.points]
                changed = [override(policy.env_config, change) for change in settings]
                found = {json.dumps(to_dict(from_dict(entry.config_class, config))) for config in changed}
                assert len(found) == len(row.points)
            elif row.task:
                paper.measure.task_config(row)
            if row.ablate:
                load_policy(row.policy).ablate(*row.ablate)
    assert len(paper.experiments.EXPERIMENTS["observations"].rows) == 7


def test_committed_tables_agree_with_the_reports(paper):
    for experiment in paper.experiments.EXPERIMENTS.values():
        path = RESULTS / experiment.name / "table.md"
        if path.exists():
            reports = paper.command.reports_of(experiment, RESULTS)
            assert path.read_text() == paper.command.markdown(experiment.table(experiment, reports)) + "\n"
