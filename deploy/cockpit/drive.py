"""The drive: a thread in which a policy drives a simulated robot in real time, and a second version its ghost.

The page reads `view`, `history` and `notes`, which are replaced as a whole, and asks for changes with `do`:
they are made between two control cycles. It knows nothing of pages and browsers.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.deploy.cockpit.ghost import Ghost
from rlservo.deploy.cockpit.policies import Choice, PolicySource, ServerLink
from rlservo.deploy.cockpit.stage import Stage, StageDisturbance, Vector, home_arguments, home_of
from rlservo.deploy.cockpit.view import Cycle, Phase, View
from rlservo.drive.driven_episode import reward_input
from rlservo.drive.fallback import StoppedError, WithFallback
from rlservo.drive.success import success_of
from rlservo.envs.rendering import Start
from rlservo.envs.ur.arm_env import URArmEnv
from rlservo.errors import (
    DeadlineError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from rlservo.policy.acting_policy import ActingPolicy
from rlservo.policy.policy import Policy
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import Recorder

logger = logging.getLogger(__name__)

HISTORY = 600  # control cycles
DWELL_S = 1.0  # between an episode's end and the next one
RETRY_S = 0.5  # between two requests while the server does not answer
IDLE_S = 0.2  # between two looks at the commands while nothing moves


class Drive:
    """A robot driven by a policy. `start` begins, `close` ends the thread and closes what it opened."""

    def __init__(
        self,
        source: PolicySource,
        choice: Choice,
        *,
        env_id: str | None = None,
        env_arguments: Mapping[str, Any] | None = None,
        seed: int | None = None,
        recorder: Recorder | None = None,
        unproven: bool = False,
    ) -> None:
        """Open the policy and make the environment, by default the one it was trained in.

        `recorder` gets every decision and what came of it. Raises UsageError if the two do not fit, or a real robot is
        not to be driven by a policy that is not proven, and what `PolicySource.open` raises.
        """
        self._source, self._recorder = source, recorder
        self._choice, self._link = choice, ServerLink()
        self._policy = source.open(choice, self._link)
        try:
            self._use(self._policy)
            contract = self._contract
            arguments = {**(home_arguments(contract) if env_id is None else {}), **(env_arguments or {})}
            self._stage = Stage(env_id or home_of(contract), arguments, contract, unproven=unproven)
        except BaseException:
            self._policy.close()
            raise
        self._disturbance = StageDisturbance()
        self._ghost: Ghost | None = None
        self._commands: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._dragged: dict[Callable[[Vector], None], Vector] = {}  # dragged, but not moved yet
        self._thread = threading.Thread(target=self._run, name="cockpit-drive", daemon=True)
        self._phase: Phase = "driving"
        self._start: Start = "own"
        self._next: tuple[Start, bool] | None = None  # the episode that begins after this one's end
        self._is_users_target = False
        self._speed = 1.0
        self._due = self._since = time.perf_counter()
        self._sentence = self._trouble = self._refusal = ""
        self._episodes = self._successes = self._late = self._fallbacks = self._cycles = 0
        self._reward = 0.0
        self.history: deque[Cycle] = deque(maxlen=HISTORY)
        self._obs: Any = None
        self._before = self._after = self._stage.scene()
        self._begin("own", keep_target=False, seed=seed)
        self.view = self._view()

    @property
    def choice(self) -> Choice:
        """The policy that drives, as requested."""
        return self._choice

    def start(self) -> None:
        """Begin to drive."""
        self._thread.start()

    def close(self) -> None:
        """End the thread, then close policies and environments, but not the source."""
        if self._thread.is_alive():
            self._commands.put(None)
            self._thread.join()
        self._drop_ghost()
        self._policy.close()
        self._stage.close()

    def do(self, command: Callable[[], None]) -> None:
        """Run one of the methods below in the drive's thread, between two control cycles."""
        self._commands.put(command)

    # -- commands, for `do`

    def play(self) -> None:
        """Continue."""
        self._phase, self._due = "driving", time.perf_counter()

    def pause(self) -> None:
        """Pause."""
        self._phase = "paused"

    def step(self) -> None:
        """Let one control cycle pass, and pause."""
        self.play()
        try:
            self._cycle()
        finally:
            self.pause()

    def begin(self, start: Start, *, keep_target: bool = False) -> None:
        """Begin an episode now; later ones that do not continue from the robot's pose start the same way."""
        if start != "here":
            self._start = start
        self._is_users_target = self._is_users_target and keep_target
        self._begin(start, keep_target=keep_target)
        if self._phase == "arrived":
            self.play()

    def take_over(self) -> None:
        """Let a person lead a real arm by hand, or give it back to the policy."""
        env = self._stage.env
        if not isinstance(env, URArmEnv):
            raise UsageError("this robot cannot be led by hand")
        env.take_over()

    def set_speed(self, speed: float) -> None:
        """Run at `speed` times real time."""
        self._speed = speed

    def drag_target(self, position: Vector) -> None:
        """Move the target, from any thread and without `do`; the latest position counts."""
        self._drag(self._put_target, position)

    def drag_robot(self, position: Vector) -> None:
        """Begin an episode with the robot at another place; like `drag_target`."""
        self._drag(self._put_robot, position)

    def move_obstacle(self, index: int, position: Vector) -> None:
        """Move an obstacle."""
        for stage in self._stages():
            stage.env.move_obstacle(index, position)
        self._show_moved()

    def disturb(self, disturbance: StageDisturbance) -> None:
        """Change the disturbances; an episode begins at the robot's pose."""
        for stage in self._stages():
            stage.disturb(disturbance)
        self._disturbance = disturbance
        self._begin("here", keep_target=True)

    def choose(
        self, choice: Choice, link: ServerLink | None = None, env_arguments: Mapping[str, Any] | None = None
    ) -> None:
        """Drive with another policy, ask for it in another way, or build another robot.

        A policy that was trained in another environment brings that. Nothing changes where something does not fit.
        """
        link = self._link if link is None else link
        policy = self._source.open(choice, link)
        try:
            stage = self._stage_for(policy.contract, choice, env_arguments)
        except BaseException:
            policy.close()
            raise
        self._policy.close()
        self._use(policy)
        self._choice, self._link = choice, link
        if stage is not self._stage:
            self._drop_ghost()
            self._stage.close()
            self._stage, self._is_users_target = stage, False
            self.history.clear()
            self._begin(self._start, keep_target=False)
        else:
            self._begin("here", keep_target=True)
        self._trouble = ""
        self.play()

    def choose_ghost(self, choice: Choice | None) -> None:
        """Let another version drive a ghost to the same target; None removes it."""
        self._drop_ghost()
        if choice is None:
            return
        self._refuse_second_robot("a ghost")
        policy = self._source.open(choice, ServerLink(self._link.deadline_ms))
        try:
            self._ghost = Ghost(policy, self._stage)
        except BaseException:
            policy.close()
            raise
        self._ghost.stage.disturb(self._disturbance)
        self._begin("here", keep_target=True)

    # -- the thread

    def _run(self) -> None:
        while True:
            wait_s = self._due - time.perf_counter() if self._phase == "driving" else IDLE_S
            try:
                command = self._commands.get(timeout=max(0.0, wait_s)) if wait_s > 0 else self._commands.get_nowait()
            except queue.Empty:
                if self._phase == "driving":
                    self._trouble = self._guarded(self._cycle) or self._trouble
                    self.view = self._view()
                continue
            if command is None:
                return
            self._refusal = self._guarded(command)
            self.view = self._view()

    def _guarded(self, command: Callable[[], None]) -> str:
        """Run a function; return its exception as text: the thread continues."""
        try:
            command()
        except (RlservoError, ValueError) as error:
            return str(getattr(error, "message", None) or error)
        except Exception as error:  # an environment is anyone's code, and a thread that ends reports nothing
            logger.exception("the cockpit's drive failed")
            self._phase = "paused"
            return f"{type(error).__name__}: {error}"
        return ""

    def _cycle(self) -> None:
        """Let one control cycle pass, or begin the next episode."""
        period_s = self._stage.cycle_s / self._speed
        self._due = max(self._due + period_s, time.perf_counter())  # a cycle that was missed is not caught up
        if self._next is not None:
            start, keep_target = self._next
            self._renew()
            self._begin(start, keep_target=keep_target)
            return
        began = time.perf_counter()
        try:
            action = self._act()
        except (UnavailableError, DeadlineError, UnknownPolicyError, StoppedError) as error:
            self._wait_for_server(error)
            return
        latency_ms = 1e3 * (time.perf_counter() - began)
        fallback, failure = "", getattr(self._policy, "failure", None)
        if failure is not None:
            fallback = failure.message
            self._fallbacks += 1
        self._trouble = fallback
        obs, value, difference = self._obs, self._value(), self._step_ghost(action)
        self._obs, self._reward, terminated, truncated, info = self._stage.step(action)
        self._show_robot(info.get("robot"))
        if isinstance(self._acting, WithRecording):
            self._acting.robot, is_over = info.get("robot"), terminated or truncated
            self._acting.record_outcome(
                self._reward, terminated=terminated, truncated=truncated,
                final_status=info.get("final_status"), final_obs=self._obs if is_over else None,
            )  # fmt: skip
        self._before, self._after, self._since = self._after, self._stage.scene(), time.perf_counter()
        is_late = bool(fallback) or latency_ms > self._late_beyond_ms()
        self._late += is_late
        self._cycles += 1
        distance = None if self._after.target is None else float(np.linalg.norm(self._after.robot - self._after.target))
        self.history.append(
            Cycle(
                number=self._cycles,
                obs=np.asarray(obs).copy(),
                action=np.atleast_1d(np.asarray(action)).copy(),
                latency_ms=latency_ms,
                is_late=is_late,
                fallback=fallback,
                warnings=self._warnings(),
                value=value,
                distance=distance,
                difference=difference,
            )
        )
        if terminated or truncated:
            self._end(info, is_arrival=terminated and bool(success_of(info)))

    def _act(self) -> Any:
        self._contract = self._policy.contract  # which asks a server again where an alias may have moved
        return self._acting.act(self._obs, **reward_input(self._contract, self._reward))

    def _show_robot(self, robot: Mapping[str, Any] | None) -> None:
        """Show the state of a real robot."""
        if robot is not None:
            self._sentence = f"Episode {self._episodes + 1}, robot: {robot['state']}."

    def _wait_for_server(self, error: RlservoError) -> None:
        """Report it and ask again soon: the robot holds still, so its observation has not changed."""
        self._late += isinstance(error, DeadlineError)
        self._trouble = f"waiting for the policy; the robot holds still: {error.message}"
        self._before = self._after
        self._due = time.perf_counter() + RETRY_S
        if isinstance(error, UnknownPolicyError):  # a server that was started again, with other versions
            policy = self._source.open(self._choice, self._link)
            self._policy.close()
            self._use(policy)
            self._begin("here", keep_target=True)

    def _renew(self) -> None:
        """Follow an alias that has been moved."""
        if not self._source.is_remote:
            return
        try:
            policy = self._source.open(self._choice, self._link)
        except (UnavailableError, DeadlineError):
            return  # the next request reports it
        before, after = self._policy.contract, policy.contract
        if (before.name, before.version) == (after.name, after.version):
            policy.close()
            return
        try:
            self._stage.check(after)
        except UsageError:
            policy.close()
            raise
        self._policy.close()
        self._use(policy)

    def _warnings(self) -> tuple[str, ...]:
        inner = self._policy.policy if isinstance(self._policy, WithFallback) else self._policy
        if isinstance(inner, Policy):
            return inner.last_notices
        reply = getattr(inner, "last_reply", {})
        return tuple(map(str, reply.get("warnings") or ()))

    def _value(self) -> float | None:
        value = self._policy.value(self._obs) if isinstance(self._policy, Policy) else None
        return None if value is None else float(value[0])

    def _step_ghost(self, action: Any) -> NDArray[Any] | None:
        """Let the ghost take its step; return how its action differs for the robot's observation."""
        try:
            return None if self._ghost is None else self._ghost.step(self._obs, action)
        except RlservoError as error:
            self._trouble = f"the ghost: {error.message}"
            return None

    # -- episodes

    def _begin(
        self, start: Start, *, keep_target: bool, position: Vector | None = None, seed: int | None = None
    ) -> None:
        self._next = None
        self._obs = self._stage.begin(start=start, position=position, keep_target=keep_target, seed=seed)
        self._acting.reset()
        self._reward = 0.0
        self._after = self._stage.scene()
        self._before = self._after
        if self._ghost is not None:
            self._ghost.begin(self._stage)
        self._sentence = f"Episode {self._episodes + 1} runs."

    def _end(self, info: Mapping[str, Any], *, is_arrival: bool) -> None:
        """Count an episode and report it; the next one continues from the robot's pose, except after a failure."""
        is_success, status = bool(success_of(info)), info.get("final_status")
        self._episodes += 1
        self._successes += is_success
        if is_arrival and self._is_users_target:
            self._phase = "arrived"
            self._sentence = "Arrived. Drag the target, or draw a new one."
            return
        goes_on = is_success or status == "max_steps_exceeded"
        self._next = ("here" if goes_on else self._start, self._is_users_target)
        self._due = time.perf_counter() + DWELL_S
        self._sentence = f"Episode {self._episodes}: {status}."
        if not goes_on and getattr(self._stage.env, "is_real", False):
            self._phase = "paused"  # a person looks at the robot first

    def _drag(self, put: Callable[[Vector], None], position: Vector) -> None:
        def put_last() -> None:
            with self._lock:
                last = self._dragged.pop(put)
            put(last)

        with self._lock:
            is_asked_for = put in self._dragged
            self._dragged[put] = position
        if not is_asked_for:
            self.do(put_last)

    def _put_robot(self, position: Vector) -> None:
        self._begin("here", position=position, keep_target=True)
        if self._phase == "arrived":
            self.play()

    def _put_target(self, position: Vector) -> None:
        for stage in self._stages():
            stage.env.move_target(position)
        self._is_users_target = True
        if self._phase == "arrived" or self._next is not None:
            self._begin("here", keep_target=True)
        if self._phase == "arrived":
            self.play()
        self._show_moved()

    def _show_moved(self) -> None:
        """Show moved objects at once, even while paused."""
        moved = self._stage.scene()
        self._before = replace(self._before, target=moved.target, obstacles=moved.obstacles)
        self._after = moved

    # -- parts

    def _use(self, policy: ActingPolicy) -> None:
        """Act with a policy from now on."""
        self._policy = policy
        self._acting = policy if self._recorder is None else WithRecording(policy, self._recorder)
        self._contract = policy.contract

    def _late_beyond_ms(self) -> float:
        return min(self._link.deadline_ms, 1e3 * self._stage.cycle_s)

    def _stages(self) -> list[Stage]:
        return [self._stage] if self._ghost is None else [self._stage, self._ghost.stage]

    def _stage_for(self, contract: Contract, choice: Choice, arguments: Mapping[str, Any] | None) -> Stage:
        """Return the present stage if the policy fits it, else a new one."""
        if arguments is None:
            if choice.name == self._choice.name:
                self._stage.check(contract)
                return self._stage
            env_id, arguments = home_of(contract), home_arguments(contract)
        else:
            env_id = self._stage.env_id
        self._refuse_second_robot("another robot")
        stage = Stage(env_id, arguments, contract)
        try:
            stage.disturb(self._disturbance)
        except ValueError:  # a payload, and a robot that carries none
            self._disturbance = replace(self._disturbance, payload=0.0)
            stage.disturb(self._disturbance)
        return stage

    def _refuse_second_robot(self, what: str) -> None:
        if getattr(self._stage.env, "is_real", False):
            raise UsageError(f"{what} cannot be combined with a real robot: restart the cockpit")

    def _drop_ghost(self) -> None:
        if self._ghost is not None:
            self._ghost.close()
            self._ghost = None

    def _view(self) -> View:
        ghost = self._ghost
        return View(
            stage=self._stage,
            contract=self._contract,
            before=self._before,
            after=self._after,
            since=self._since,
            period_s=self._stage.cycle_s / self._speed,
            ghost=None if ghost is None else ghost.scenes,
            ghost_contract=None if ghost is None else ghost.contract,
            phase=self._phase,
            sentence=self._sentence,
            trouble=self._trouble,
            refusal=self._refusal,
            episodes=self._episodes,
            successes=self._successes,
            late=self._late,
            late_beyond_ms=self._late_beyond_ms(),
            fallbacks=self._fallbacks,
        )
