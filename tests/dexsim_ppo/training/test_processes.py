"""What one process of several does and does not, with the others made up."""

import jax
import pytest

from dexsim.core.errors import DexsimError
from dexsim_ppo.training import processes


@pytest.mark.parametrize("job", ["SLURM_STEP_NODELIST", "OMPI_COMM_WORLD_SIZE", "JOB_COMPLETION_INDEX", None])
def test_processes_of_a_job_join_and_a_single_one_does_not(job, monkeypatch):
    joined = []
    for name in ("SLURM_STEP_NODELIST", "OMPI_COMM_WORLD_SIZE", "JOB_COMPLETION_INDEX"):
        monkeypatch.delenv(name, raising=False)
    if job:
        monkeypatch.setenv(job, "1")
    met = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **options: joined.append(options))
    monkeypatch.setattr(processes, "agree", lambda number: met.append(len(joined)))
    processes.connect()
    assert len(joined) == bool(job)
    assert met == [1] * bool(job), "they exchange something before one of them compiles for long"
    if job:  # A dead process is noticed within minutes, and the first one's report is waited for.
        assert joined[0]["heartbeat_timeout_seconds"] <= 120 < 1800 <= joined[0]["shutdown_timeout_seconds"]
        monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
        processes.connect()
        assert len(joined) == 1, "once"

        def refuse(**_):
            raise RuntimeError("nobody there")

        monkeypatch.setattr(jax.distributed, "is_initialized", lambda: False)
        monkeypatch.setattr(jax.distributed, "initialize", refuse)
        with pytest.raises(DexsimError, match="cannot be reached: nobody there"):
            processes.connect()
