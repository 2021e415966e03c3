"""One training run: compile, loop, measure, save, report."""

import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim.core import cli
from dexsim.core.config import to_dict
from dexsim.core.errors import ConfigError
from dexsim.env.evaluation import evaluation_of
from dexsim.hand.source import record_of
from dexsim_ppo import checkpoint
from dexsim_ppo.evaluate import Evaluator, write_video
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import TrainState, make_train
from dexsim_ppo.learner.sharding import place
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.policy import Policy, load_policy
from dexsim_ppo.report import headline, print_report, significantly_better
from dexsim_ppo.training import processes
from dexsim_ppo.training.arguments import TrainArguments, printable, training_config
from dexsim_ppo.training.display import Display
from dexsim_ppo.training.faults import Faults, keep
from dexsim_ppo.training.fine_tune import initialize_from
from dexsim_ppo.training.runlog import MetricsLog, RunFolder, draw_curve, means, read_metrics

# Selecting the best policy uses starts and episodes that no report has: `evaluate --seed` ends below.
SELECTION_SEED, REPORT_SEED = 2**32 - 1, 0


def due(iteration: int, per_call: int, every: int) -> bool:
    """Whether a call of `per_call` iterations that ended at `iteration` passed a multiple of `every`; 0 is never."""
    return every > 0 and iteration // every > (iteration - per_call) // every


def check_memory(program: Any, num_envs: int) -> str:
    """What a compiled training step needs and the device has, in a line; empty where the runtime does not say.

    Raises:
      ConfigError: it needs more than there is; names a number of environments that should fit.
    """
    analysis, device = program.memory_analysis(), jax.local_devices()[0]
    if device.platform == "cpu":
        limit = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    else:
        limit = (device.memory_stats() or {}).get("bytes_limit", 0)
    if analysis is None or not limit:
        return ""
    # Results that take the place of arguments (`alias`) are counted with these.
    results = analysis.output_size_in_bytes - analysis.alias_size_in_bytes
    need = analysis.argument_size_in_bytes + results + analysis.temp_size_in_bytes
    text = f"{num_envs} environments need {need / 2**30:.3g} GiB, {device.device_kind} has {limit / 2**30:.3g} GiB"
    if need > limit:
        fit = 2 ** int(math.log2(max(num_envs * limit / need, 1.0)))
        raise ConfigError(f"{text}: about {fit} should fit (--ppo.num-envs {fit})")
    return text


class Run:
    """One training run. `train` and then `finish` leave everything in its folder."""

    def __init__(
        self,
        env: Environment,
        arguments: TrainArguments,
        folder: RunFolder,
        started: float,
        mesh: Mesh | None = None,
        evaluator: Evaluator | None = None,
    ):
        """`evaluator` is that of another run which differs in its seed only; None makes one."""
        self.env, self.arguments, self.folder, self.started, self.mesh = env, arguments, folder, started, mesh
        self.config: PPOConfig = arguments.ppo
        self.evaluator = evaluator or Evaluator(self._evaluation_env(), arguments.evaluation_chunk)
        self.best: dict[str, Any] = {"return": None, "iteration": 0}
        self.evaluations_s = list[float]()
        self.without_better = 0  # evaluations in a row
        self.seconds_before = 0.0
        """Wall-clock time before a resume, s."""
        self.clock = {"setup_s": time.perf_counter() - started}

    def _evaluation_env(self) -> Environment:
        """The training environment, or one of its own where training has extremes or no force loop."""
        if training_config(self.arguments) is self.arguments.env:
            return self.env
        import dexsim

        return dexsim.make(
            self.arguments.task,
            self.arguments.env,
            backend=self.env.backend,
            hand=getattr(self.env, "hand", None),
        )

    def train(self, source: checkpoint.Checkpoint | Policy | None, stopped: Callable[[], int]) -> None:
        """The training loop; ends with a checkpoint and the last policy.

        Args:
          source: a checkpoint to resume, a policy to fine-tune, or None to start from scratch.
          stopped: nonzero once the run is to end early, in all processes alike.
        """
        arguments, device, devices = self.arguments, jax.devices()[0].device_kind, self.mesh.size if self.mesh else 1
        if devices > 1:
            device = f"{devices} x {device}"
        with Display(f"{arguments.task} on {device}, {self.env.backend}", not processes.is_first()) as display:
            display.note(
                f"{self.folder.path}: {arguments.task}, {self.config.num_envs} environments, "
                f"{self.env.backend} physics on {device}"
            )
            display.working("compiling the training step: a minute on two cores, seconds once it is in the cache")
            state, step = self._prepare(source)
            display.note(f"compiled in {self.clock['compile_s']:.1f} s")
            if memory := check_memory(step, self.config.num_envs // devices):
                display.note(memory)
            display.working("first update")
            log = MetricsLog(self.folder, int(state.iteration), arguments) if processes.is_first() else None
            try:
                self._loop(state, step, display, log, stopped)
            finally:
                if log:
                    log.close()

    def _prepare(self, source: checkpoint.Checkpoint | Policy | None) -> tuple[TrainState, Callable]:
        """The state to start from and the compiled training step."""
        training = make_train(self.env, self.config, self.arguments.curriculum, self.mesh)
        key, begin = jax.random.key(self.arguments.seed), time.perf_counter()
        shapes = training.shapes(key)
        # One core compiles and runs `init` while another traces the step.
        with ThreadPoolExecutor(1) as aside:
            if isinstance(source, checkpoint.Checkpoint):
                state = checkpoint.restore(source, shapes)
                state = place(state, shapes) if self.mesh is not None else jax.tree.map(jnp.copy, state)
                progress = source.content["progress"]
                self.best = progress["best"] if self.folder.has_best(int(state.iteration)) else self.best
                self.seconds_before, self.without_better = progress["seconds"], progress["without_better"]
            else:
                fresh = aside.submit(lambda: jax.block_until_ready(training.init(key)))
            lowered = cast(Any, training.step).lower(shapes)
            self.clock["trace_s"] = time.perf_counter() - begin
            step = lowered.compile()
            if not isinstance(source, checkpoint.Checkpoint):
                state = self._begin(fresh.result(), source)
        self.clock["compile_s"] = time.perf_counter() - begin
        return state, step

    def _begin(self, state: TrainState, source: Policy | None) -> TrainState:
        """The fresh state with what the policy to fine-tune has learnt; writes the untrained policy."""
        if source:
            fresh, state = state, initialize_from(source, self.config, state)
            if self.mesh is not None:
                learner = place((state.params, state.observation_stats), (fresh.params, fresh.observation_stats))
                state = dataclasses.replace(state, params=learner[0], observation_stats=learner[1])
        self._write_policy(self._policy(state), self.folder.untrained)
        return state

    def _loop(
        self, state: TrainState, step: Callable, display: Display, log: MetricsLog | None, stopped: Callable[[], int]
    ) -> None:
        arguments, per_call = self.arguments, self.config.iterations_per_call
        iteration = first = int(state.iteration)
        begin, spent_elsewhere = time.perf_counter(), 0.0
        faults = Faults(self.config, self.folder, arguments.task, state, self._save_checkpoint)
        evaluated = iteration == 0
        while not stopped() and not processes.agree(self._is_over(iteration)):
            call = time.perf_counter()
            before = keep(state)
            state, metrics = step(state)
            metrics = jax.device_get(metrics)
            now, iteration = time.perf_counter(), iteration + per_call
            if "first_update_s" not in self.clock:
                self.clock |= {"first_update_s": now - self.started, "first_call_s": now - call}
                display.note(
                    f"first update {self.clock['first_update_s']:.1f} s after the start, "
                    f"{now - call:.1f} s of it for itself"
                )
            row = means(metrics) | faults.check(before, metrics, iteration, display.note)
            del before
            row |= self._progress(iteration, now - call)
            evaluated = self._is_evaluation_due(iteration, row["env_steps_per_s"])
            if evaluated:
                row |= self._evaluate(state, iteration, display)
            if evaluated or iteration == first + per_call or due(iteration, per_call, arguments.log_every):
                if log:
                    log.write(row)
                display.show(row)
            if due(iteration, per_call, arguments.checkpoint_every):
                self._save(state, iteration)
            spent_elsewhere += time.perf_counter() - now
        self.clock["training_s"] = time.perf_counter() - begin
        self.clock["step_s"] = self.clock["training_s"] - spent_elsewhere
        self.clock["env_steps"] = iteration * self.config.steps_per_iteration
        # The first call is left out of the rate: what is compiled or loaded at first use is in it.
        steps = max(iteration - first - per_call, 0) * self.config.steps_per_iteration
        self.clock["env_steps_per_s"] = steps / max(self.clock["step_s"] - self.clock.get("first_call_s", 0.0), 1e-9)
        if self.best["return"] is not None and not stopped() and not evaluated:
            self._evaluate(state, iteration, display)
        self._save(state, iteration)

    # --- budgets ------------------------------------------------------------------------------------------

    def _seconds(self) -> float:
        """Wall-clock time of the whole run, including that before a resume, s."""
        return self.seconds_before + time.perf_counter() - self.started

    def _is_over(self, iteration: int) -> bool:
        """Whether a budget is used up, or the return no longer gets better."""
        return 0 < self.arguments.patience <= self.without_better or self._seconds_left(iteration, 1.0) <= 0

    def _is_evaluation_due(self, iteration: int, env_steps_per_s: float) -> bool:
        """Whether to evaluate after a call that ended at `iteration`: that evaluation, and the one at the end, must
        keep to their share of the time. The same in all processes."""
        arguments = self.arguments
        if not due(iteration, self.config.iterations_per_call, arguments.evaluate_every):
            return False
        guess = arguments.evaluation_chunk * evaluation_of(self.env).evaluation_steps / env_steps_per_s
        # The first one's time is mostly compilation, which the report at the end needs anyway.
        spent = [guess, *self.evaluations_s[1:]] if self.evaluations_s else []
        each = spent[-1] if spent else guess
        return bool(processes.agree(sum(spent) + 2 * each <= arguments.evaluation_share * self._seconds()))

    def _seconds_left(self, iteration: int, env_steps_per_s: float) -> float:
        """Time until the first budget is used up, s; infinite without a budget."""
        steps, minutes = self.arguments.steps, self.arguments.minutes
        left = [float("inf")]
        if steps:
            left.append((steps - iteration * self.config.steps_per_iteration) / env_steps_per_s)
        if minutes:
            left.append(60 * minutes - self._seconds())
        return min(left)

    def _progress(self, iteration: int, call_s: float) -> dict[str, float]:
        rate = self.config.iterations_per_call * self.config.steps_per_iteration / call_s
        return {
            "iteration": iteration,
            "env_steps": iteration * self.config.steps_per_iteration,
            "seconds": self._seconds(),
            "env_steps_per_s": rate,
            "seconds_left": self._seconds_left(iteration, rate),
        }

    # --- files and reports --------------------------------------------------------------------------------

    def _policy(self, state: TrainState) -> Policy:
        learner = jax.device_get(dataclasses.replace(cast(Any, state), env_state=None, carry=None, key=None))
        return Policy.from_training(
            self.evaluator.env,
            self.config,
            learner,
            {
                "seed": self.arguments.seed,
                "iteration": int(learner.iteration),
                "env_steps": int(learner.iteration) * self.config.steps_per_iteration,
                "backend": self.env.backend,
                "ppo": to_dict(self.config),
            }
            | ({"policy": self.arguments.policy} if self.arguments.policy else {}),
        )

    def _evaluate(self, state: TrainState, iteration: int, display: Display) -> dict[str, float]:
        """Evaluate the policy, and save it if its return is the best so far."""
        policy = self._policy(state)
        display.working(f"evaluating the policy in {self.arguments.evaluation_chunk} episodes")
        report, _ = self.evaluator(policy.params, episodes=self.arguments.evaluation_chunk, seed=SELECTION_SEED)
        figures = {name: entry["value"] for name, entry in headline(report).items() if entry["value"] is not None}
        score, first, best = figures["return"], next(iter(figures)), self.best["return"]
        self.evaluations_s.append(report["seconds"])
        better = best is None or best != best or score > best  # Nothing is better than NaN, and NaN than nothing.
        self.without_better = 0 if better else self.without_better + 1
        if better:
            self.best = {"return": score, "iteration": iteration}
            self._write_policy(policy, self.folder.best)
        display.note(
            f"evaluation at iteration {iteration}: {first} {figures[first]:.3g}, return {score:.2f}"
            f", {'the best so far' if better else f'{self.without_better} without a better one'} "
            f"({report['seconds']:.1f} s)"
        )
        return {f"evaluation/{name}": x for name, x in (figures | {"held": report["held"]["value"]}).items()}

    def _save(self, state: TrainState, iteration: int) -> None:
        """Save a checkpoint, from which training resumes exactly, and the current policy."""
        self._save_checkpoint(self.folder.checkpoint(iteration), state)
        if processes.is_first():
            self.folder.prune(self.arguments.keep_checkpoints)
        self._write_policy(self._policy(state), self.folder.last)

    def _save_checkpoint(self, path: Path, state: TrainState) -> None:
        processes.save(
            path,
            kind="train",
            task=self.arguments.task,
            tree=state,
            content={
                "arguments": printable(self.arguments),
                "hand": record_of(getattr(self.env, "hand", None)),
                "progress": {"best": self.best, "seconds": self._seconds(), "without_better": self.without_better},
            },
        )

    def _write_policy(self, policy: Policy, path: Path) -> None:
        if processes.is_first():
            policy.save(path)

    @property
    def selected(self) -> Path:
        """The file of the policy that the run is judged by: the best one, or else the last."""
        return self.folder.best if self.folder.best.exists() else self.folder.last

    def finish(self, command: str) -> None:
        """Evaluate trained and untrained policy and a hand that does nothing on the same episodes; write curve, report
        and video.

        `command` is what started the run, for the report.
        """
        arguments, folder, selected = self.arguments, self.folder, self.selected
        print(f"evaluating {selected.name}, the untrained policy and a hand that does nothing", flush=True)
        begin = time.perf_counter()
        trained, untrained = load_policy(selected), load_policy(folder.untrained)
        if trained.training.get("iteration") == 0:  # An average of policies, put there by hand, has none.
            print(f"nothing was trained: compiling took {self.clock['compile_s']:.0f} s; give more --minutes")
        measure = functools.partial(self.evaluator, episodes=arguments.evaluation_episodes, seed=REPORT_SEED)
        reports = {}
        reports["trained"], film = measure(trained.params, label="trained")
        reports["untrained"], _ = measure(untrained.params, label="untrained")
        reports["do_nothing"], _ = measure(untrained.params, idle=True, label="doing nothing")
        self.clock["evaluation_s"] = time.perf_counter() - begin
        draw_curve([read_metrics(folder.metrics)], folder.path / "curve.png", arguments.task)
        report = {
            "task": arguments.task,
            "policy": selected.name,
            "origin": trained.training,
            "backend": self.env.backend,
            "seed": arguments.seed,
            **reports,
            "better": significantly_better(reports["trained"], reports["untrained"]),
            "command": command,
            "arguments": printable(arguments),
            "timing": self.clock,
        } | cli.environment_report()
        folder.keep_report()
        cli.write_json(folder.report, report)
        for name, policy in (("untrained", "untrained"), ("trained", selected)):
            print_report(reports[name], reports["do_nothing"], title=f"{arguments.task}: {policy}")
        if arguments.video and jax.tree.leaves(film):  # an environment from elsewhere draws nothing
            print("rendering the video", flush=True)
            begin = time.perf_counter()
            video = write_video(self.evaluator.env, film, folder.path / "policy.mp4")
            self.clock["video_s"] = time.perf_counter() - begin
            print(f"video: {video}")
        self.clock["total_s"] = time.perf_counter() - self.started
        cli.write_json(folder.report, report)
        print(f"report: {folder.report}")
