"""What one process of several does and does not, with the others made up."""

import jax
import pytest

from dexsim.core.errors import DexsimError
from dexsim_ppo.training import processes


@pytest.fixture
def several(monkeypatch):
    """`several(index)` makes this process the one with that number, of three."""

    def be(index):
        monkeypatch.setattr(jax, "process_count", lambda: 3)
        monkeypatch.setattr(jax, "process_index", lambda: index)

    return be


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


def test_the_loss_of_another_process_is_one_line_and_other_errors_stay(several, tmp_path):
    def fail(text):
        with processes.detect_lost_peer(tmp_path):
            raise ValueError(text)

    with pytest.raises(ValueError, match="Gloo"):
        fail("Gloo AllGather failed")  # there is no other
    several(0)
    for text in ("Gloo AllGather failed", "NCCL operation", "UNAVAILABLE: x", "ABORTED: x", "DEADLINE_EXCEEDED"):
        with pytest.raises(DexsimError, match=f"has ended; resume with: .*--resume {tmp_path} --devices 1"):
            fail(text)
    with pytest.raises(ValueError, match="shapes"):
        fail("shapes do not match")
