"""One training run: compile, loop, measure, save, report."""

import contextlib
import dataclasses
import functools
import shlex
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import jax
from jax.sharding import Mesh

import dexsim
from dexsim.core import cli
from dexsim.core.config import to_dict
from dexsim.errors import DexsimError
from dexsim.hand.source import record_of
from dexsim.registry import task_option
from dexsim_ppo import checkpoint
from dexsim_ppo.evaluate import Evaluator, headline, print_report, write_video, written
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import TrainState, make_train
from dexsim_ppo.learner.running_stats import recover_stats
from dexsim_ppo.learner.sharding import place
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.policy import Policy, load_policy
from dexsim_ppo.training import processes
from dexsim_ppo.training.arguments import TrainArguments, printable, training_config
from dexsim_ppo.training.runlog import MetricsLog, RunFolder, draw_curve, means, policy_of, progress_line, read_metrics

# Selecting the best policy uses starts and episodes that no report has: `evaluate --seed` ends below.
SELECTION_SEED, REPORT_SEED = 2**32 - 1, 0
DIVERGED_AFTER = 5  # calls in a row that skip more than half of their updates


def due(iteration: int, per_call: int, every: int) -> bool:
    """Whether a call of `per_call` iterations that ended at `iteration` passed a multiple of `every`; 0 is never."""
    return every > 0 and iteration // every > (iteration - per_call) // every


class Run:
    """One training run. `train` and then `finish` leave everything in its folder. `started` is `time.perf_counter()` at
    the start of the command."""

    def __init__(
        self, env: Environment, arguments: TrainArguments, folder: RunFolder, started: float, mesh: Mesh | None = None
    ):
        self.env, self.arguments, self.folder, self.started, self.mesh = env, arguments, folder, started, mesh
        self.config: PPOConfig = arguments.ppo
        self.evaluator = Evaluator(self._evaluation_env(), arguments.evaluation_chunk)
        self.best: dict[str, Any] = {"return": None, "iteration": 0}
        self.evaluations_s = list[float]()
        self.without_better = 0  # evaluations in a row
        self.seconds_before = 0.0  # s, wall-clock time before a resume
        self.clock: dict[str, float] = {}

    def _evaluation_env(self) -> Environment:
        """The training environment, or one of its own where training has extremes or no force loop."""
        if training_config(self.arguments) is self.arguments.env:
            return self.env
        hand = getattr(self.env, "hand", None)
        return dexsim.make(self.arguments.task, self.arguments.env, backend=self.env.backend, hand=hand)

    def train(self, source: checkpoint.Checkpoint | Policy | None, stopped: Callable[[], int]) -> None:
        """The training loop; ends with a checkpoint and the last policy.

        Args:
          source: a checkpoint to resume, a policy to fine-tune, or None to start from scratch.
          stopped: nonzero once the run is to end early, in all processes alike.
        """
        devices, device = self.mesh.size if self.mesh else 1, jax.devices()[0].device_kind
        processes.print_on_first(
            f"{self.folder.path}: {self.arguments.task}, {self.config.num_envs} environments, {self.env.backend} "
            f"physics on {f'{devices} x ' if devices > 1 else ''}{device}"
        )
        processes.print_on_first("compiling the training step: a minute on two cores, seconds once it is in the cache")
        state, step = self._prepare(source)
        processes.print_on_first(f"compiled in {self.clock['compile_s']:.1f} s")
        resumed = source if isinstance(source, checkpoint.Checkpoint) else None
        log = MetricsLog(self.folder, self.arguments, resumed) if processes.is_first() else None
        with contextlib.closing(log) if log else contextlib.nullcontext():
            self._loop(state, step, log, stopped)

    def _prepare(self, source: checkpoint.Checkpoint | Policy | None) -> tuple[TrainState, Callable]:
        """The state to start from and the compiled training step."""
        start = functools.partial(initialize_from, source) if isinstance(source, Policy) else None
        training = make_train(self.env, self.config, self.arguments.curriculum, self.mesh, start)
        key, begin = jax.random.key(self.arguments.seed), time.perf_counter()
        shapes = training.shapes(key)
        resumed = self._resume(source, shapes) if isinstance(source, checkpoint.Checkpoint) else None
        with ThreadPoolExecutor(1) as aside:  # One core compiles and runs `init` while another traces the step.
            fresh = aside.submit(lambda: resumed or jax.block_until_ready(training.init(key)))
            step = cast(Any, training.step).lower(shapes).compile()
        self.clock["compile_s"] = time.perf_counter() - begin
        return fresh.result(), step

    def _resume(self, source: checkpoint.Checkpoint, shapes: TrainState) -> TrainState:
        state, progress = checkpoint.restore(source, shapes), source.content["progress"]
        if self.folder.has_best(source):
            self.best = progress["best"]
        elif progress["best"]["return"] is not None:  # The file is of another course: the next one replaces it.
            self.best = {"return": float("nan"), "iteration": 0}
        self.seconds_before, self.without_better = progress["seconds"], progress["without_better"]
        return place(state, shapes)

    def _loop(self, state: TrainState, step: Callable, log: MetricsLog | None, stopped: Callable[[], int]) -> None:
        arguments, per_call = self.arguments, self.config.iterations_per_call
        per_iteration = self.config.steps_per_iteration
        iteration = first = int(state.iteration)
        begin, calls_s, evaluated = time.perf_counter(), list[float](), iteration == 0
        # Updates skipped so far, the last iteration without one, and calls in a row that skipped most.
        self.skipped, self.sound, self.bad_calls = int(state.skipped_updates), iteration, 0
        while not stopped() and not processes.agree(self._is_over(iteration)):
            call = time.perf_counter()
            state, metrics = step(state)
            metrics = jax.device_get(metrics)
            calls_s.append(time.perf_counter() - call)
            iteration += per_call
            if len(calls_s) == 1:
                self.clock["first_update_s"] = time.perf_counter() - self.started
                processes.print_on_first(f"first update {self.clock['first_update_s']:.1f} s after the start")
            self._check_faults(int(metrics["skipped_updates"][-1]), iteration)
            rate = per_call * per_iteration / calls_s[-1]
            row = means(metrics) | {
                "iteration": iteration,
                "env_steps": iteration * per_iteration,
                "seconds": self._seconds(),
                "env_steps_per_s": rate,
                "seconds_left": self._seconds_left(iteration, rate),
            }
            evaluated = self._is_evaluation_due(iteration)
            if evaluated:
                row |= self._evaluate(state, iteration)
            if evaluated or iteration == first + per_call or due(iteration, per_call, arguments.log_every):
                if log:
                    log.write(row)
                processes.print_on_first(progress_line(row))
            if due(iteration, per_call, arguments.checkpoint_every):
                self._save(state, iteration)
        self.clock["training_s"] = time.perf_counter() - begin
        # The first call is left out of the rate: what is compiled or loaded at first use is in it.
        steps = max(iteration - first - per_call, 0) * per_iteration
        self.clock["env_steps_per_s"] = steps / max(sum(calls_s[1:]), 1e-9)
        if self.best["return"] is not None and not stopped() and not evaluated:
            self._evaluate(state, iteration)
        self._save(state, iteration)

    def _check_faults(self, skipped: int, iteration: int) -> None:
        """Raises DexsimError: most updates of several calls in a row were `skipped`, their number in the whole run,
        because their gradient was not finite."""
        lost, self.skipped = skipped - self.skipped, skipped
        updates = self.config.iterations_per_call * self.config.epochs * self.config.minibatches
        self.bad_calls = self.bad_calls + 1 if 2 * lost > updates else 0
        if not lost:
            self.sound = iteration
        if self.bad_calls >= DIVERGED_AFTER:
            sound = [path for path in self.folder.existing_checkpoints() if int(path.stem) <= self.sound]
            raise DexsimError(
                f"training diverged: in each of the last {DIVERGED_AFTER} calls most gradients were not finite, the "
                f"first one after iteration {self.sound}; "
                + (f"the newest checkpoint from before is {sound[-1]}" if sound else "no checkpoint is from before")
            )

    # --- budgets ------------------------------------------------------------------------------------------

    def _seconds(self) -> float:
        """Wall-clock time of the whole run, including that before a resume, s."""
        return self.seconds_before + time.perf_counter() - self.started

    def _is_over(self, iteration: int) -> bool:
        """Whether a budget is used up, or the return no longer gets better."""
        return 0 < self.arguments.patience <= self.without_better or self._seconds_left(iteration, 1.0) <= 0

    def _is_evaluation_due(self, iteration: int) -> bool:
        """Whether to evaluate after a call that ended at `iteration`: that evaluation, and the one at the end, must
        keep to their share of the time. The same in all processes."""
        if not due(iteration, self.config.iterations_per_call, self.arguments.evaluate_every):
            return False
        # The first one's time is mostly compilation, which the report at the end needs anyway.
        spent = self.evaluations_s[1:]
        allowed = not spent or sum(spent) + 2 * spent[-1] <= self.arguments.evaluation_share * self._seconds()
        return bool(processes.agree(allowed))

    def _seconds_left(self, iteration: int, env_steps_per_s: float) -> float:
        """Time until the first budget is used up, s; infinite without a budget."""
        steps, minutes = self.arguments.steps, self.arguments.minutes
        left = [float("inf")]
        if steps:
            left.append((steps - iteration * self.config.steps_per_iteration) / env_steps_per_s)
        if minutes:
            left.append(60 * minutes - self._seconds())
        return min(left)

    # --- files and reports --------------------------------------------------------------------------------

    def _policy(self, state: TrainState) -> Policy:
        learner = jax.device_get(dataclasses.replace(cast(Any, state), env_state=None, carry=None, key=None))
        origin = {
            "seed": self.arguments.seed,
            "iteration": int(learner.iteration),
            "env_steps": int(learner.iteration) * self.config.steps_per_iteration,
            "backend": self.env.backend,
            "ppo": to_dict(self.config),
        }
        if self.arguments.policy:
            origin["policy"] = self.arguments.policy
        return Policy.from_training(self.evaluator.env, learner, origin)

    def _evaluate(self, state: TrainState, iteration: int) -> dict[str, float]:
        """Evaluate the policy, and save it if its return is the best so far."""
        policy = self._policy(state)
        if not self.evaluations_s:
            processes.print_on_first("evaluating, to keep the best policy; the first evaluation compiles for a minute")
        label, episodes = "evaluation" if processes.is_first() else "", self.arguments.evaluation_chunk
        report, _ = self.evaluator(policy.params, episodes=episodes, seed=SELECTION_SEED, label=label)
        entries = {name: entry for name, entry in headline(report).items() if entry["value"] is not None}
        figures = {name: entry["value"] for name, entry in entries.items()}
        score, first, best = figures["return"], next(iter(figures)), self.best["return"]
        self.evaluations_s.append(report["seconds"])
        better = best is None or best != best or score > best  # Nothing is better than NaN, and NaN than nothing.
        self.without_better = 0 if better else self.without_better + 1
        if better:
            self.best = {"return": score, "iteration": iteration}
            if processes.is_first():
                policy.save(self.folder.best)
        processes.print_on_first(
            f"evaluation at iteration {iteration}: {first} {written(entries[first])}, return {score:.2f}"
            f", {'the best so far' if better else f'{self.without_better} without a better one'} "
            f"({report['seconds']:.1f} s)"
        )
        return {f"evaluation/{name}": x for name, x in (figures | {"held": report["held"]["value"]}).items()}

    def _save(self, state: TrainState, iteration: int) -> None:
        """Save a checkpoint, from which training resumes exactly, and the current policy."""
        path, policy = self.folder.checkpoint(iteration), self._policy(state)
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
        if processes.is_first():
            policy.save(policy_of(path))
            policy.save(self.folder.last)
            self.folder.prune(self.arguments.keep_checkpoints)

    @property
    def selected(self) -> Path:
        """The file of the policy that the run is judged by: the best one, or else the last."""
        return self.folder.best if self.folder.best.exists() else self.folder.last

    def finish(self, command: str) -> None:
        """Evaluate the policy and a hand that does nothing on the same episodes; write curve, report and video.

        `command` is what started the run, for the report.
        """
        arguments, folder, selected = self.arguments, self.folder, self.selected
        first = "" if self.evaluations_s else "; the first evaluation compiles for about a minute"
        print(f"evaluating {selected.name} and a hand that does nothing{first}", flush=True)
        trained = load_policy(selected)
        if trained.training.get("iteration") == 0:
            print(f"nothing was trained: compiling took {self.clock['compile_s']:.0f} s; give more --minutes")
        measure = functools.partial(self.evaluator, episodes=arguments.evaluation_episodes, seed=REPORT_SEED)
        reports = {}
        reports["trained"], film = measure(trained.params, label="trained")
        reports["do_nothing"], _ = measure(trained.params, idle=True, label="doing nothing")
        print_report(reports["trained"], reports["do_nothing"], title=f"{arguments.task}: {selected.name}")
        draw_curve(read_metrics(folder.metrics), folder.path / "curve.png", arguments.task)
        report = {
            "task": arguments.task,
            "policy": selected.name,
            "origin": trained.training,
            "backend": self.env.backend,
            "seed": arguments.seed,
            **reports,
            "command": command,
            "arguments": printable(arguments),
            "timing": self.clock | {"total_s": time.perf_counter() - self.started},
        } | cli.environment_report()
        folder.keep_report()
        cli.write_json(folder.report, report)
        print(f"report: {folder.report}")
        if arguments.video and jax.tree.leaves(film):  # an environment from elsewhere draws nothing
            print("rendering the video: a few minutes on two cores", flush=True)
            print(f"video: {write_video(self.evaluator.env, film, folder.path / 'policy.mp4')}")
        module = task_option(arguments.task)
        if hasattr(self.env, "hand") and not module:
            print(f"see it in the browser: dexsim view {shlex.quote(str(selected))}")
        resume = f"dexsim train --resume {shlex.quote(str(folder.path))}{module}"
        print(f"train longer: {resume}, with a larger --minutes or --steps")


def initialize_from(policy: Policy, state: TrainState) -> TrainState:
    """A fresh learner's state with the policy's actor and observation statistics: the actor's inputs keep the
    normalisation that it was trained with."""
    with jax.ensure_compile_time_eval():
        stats = recover_stats(policy.params.normalizer)
    actor, memory = policy.params.layers, policy.params.memory
    return dataclasses.replace(
        state,
        params=dataclasses.replace(state.params, actor=actor, memory=memory),
        average=(actor, memory),
        observation_stats=state.observation_stats | {"actor": stats},
    )
