"""Moves the arm: plans each command in a worker thread, and executes the plan tick by tick."""

from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.objects import SeenSolid
from gigabrain_schemas.topics import ARM_MODEL
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.arm_readings import (
    ArmReading,
    begins_at,
    off_from,
    pace,
    rest_of_place,
)
from gigabrain_zenoh.decision.arm_touch import Touch
from gigabrain_zenoh.decision.arm_work import (
    Planned,
    WorkInputs,
    moving,
    names_gripper,
    work_for,
)
from gigabrain_zenoh.decision.behaviours import (
    ArmCommand,
    Idle,
    StepOutcome,
    StepResult,
    Target,
)
from gigabrain_zenoh.decision.grip import Grip
from gigabrain_zenoh.decision.held_things import (
    floor_of,
    placed,
    thing_of,
)
from gigabrain_zenoh.decision.plan_display import PlanDisplay
from gigabrain_zenoh.decision.seen_things import (
    Lookout,
    PutDown,
    approach,
    located,
    still_stands,
    unseen,
)
from gigabrain_zenoh.decision.tasks.arm_steps import (
    ArmAction,
    AwaitTaken,
    Held,
    Pick,
    Press,
    Solid,
    TakePosture,
)
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Plan
from gigabrain_zenoh.manipulation.collision import Thing
from gigabrain_zenoh.manipulation.phases import PhaseRun
from gigabrain_zenoh.manipulation.pick_place import NoWay

TRIES = 3  # grasps of a thing, each one different
HOLD_UPS = 5  # a command with more hold-ups fails
MAX_RESULTS = 64  # of commands, that are remembered
WAIT_TICKS = 100  # until the arm plans again, for a joint that the gate holds back
MISSED = f"the gripper missed it {TRIES} times"
CARRYING = ("lift", "traverse", "lower", "move")  # phases in which the gripper must hold a thing
NO_MODEL = Idle("waiting", "waiting: for the arm's model, robot/arm_model")
NOT_MEASURED = Idle("waiting", "waiting: for all joints to be measured")
PLANNING = Idle("planning", "planning")
OFFERING = "waiting for a person to pull at {}; `gigabrain task resume` opens the gripper"
GRIPPER_STAYS = "so the gripper stays; `place` and `gripper` let go of it"


class Manipulator:
    """Carries out one command for the arm at a time."""

    def __init__(self, bus: Bus, behaviour: str, held: Held | None = None) -> None:
        """Prepare for one arm; `held` is what its gripper held before a restart."""
        self._behaviour, self._in_time = behaviour, bus.input_log.in_time
        self._models, self._display = bus.latest(ARM_MODEL), PlanDisplay(bus)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="arm")
        self._planner_inputs: tuple[str, BodyDescription] | None = None  # MJCF and body
        self._loading: Future[ArmPlanner] | None = None
        self._planner: ArmPlanner | None = None
        self._planning: Future[Planned] | None = None
        self._plan = Plan(phases=())
        self._run: PhaseRun | None = None
        self._grip = Grip(held)
        self._number = 0  # of the current or last command
        self._misses = 0  # failed grasps in this command
        self._hold_ups = 0  # in this command: a joint did not follow
        self._achieved = StepOutcome()  # its result, while the arm only has to move back
        # results of earlier commands: a command continues after a task that interrupted it
        self._results: deque[StepOutcome] = deque(maxlen=MAX_RESULTS)
        self._put_down: StepOutcome | None = None  # result once the gripper lets go of its thing
        self._abandoned: Plan | None = None  # was cut short: the hand may still be at the thing
        self._base_pose = Pose(x=0.0, y=0.0, yaw=0.0)  # of the body when the arm last moved
        self._detour = False  # this plan backs off, or clears a view; then the arm plans again
        self._failure = ""  # failure to report after backing off
        self._touch: Touch | None = None  # while pressing or offering
        self._lookout = Lookout()
        self._camera_id: int | None = None  # number of the picked thing in what cameras see
        self._target: Thing | None = None  # to be picked up, where it stands
        self._put: PutDown | None = None  # was put down, and not seen there since

    def step(
        self,
        state: RobotState,
        body: BodyDescription,
        command: ArmCommand | None,
        idle: Idle,
        held: str,
        seen: tuple[SeenSolid, ...] = (),
    ) -> StepResult:
        """Carry out `command` for one step; without one, hold still with the reason `idle`.

        `held` is the reason why the body ignores decision, if it does. Then the arm holds still,
        and plans again afterwards. Things without a place are located in `seen`, in the body's
        frame.
        """
        intent, outcome = self._step(state, body, command, idle, held, seen)
        if self._planner and not self._run and not held:
            arm = ArmReading(self._planner, body, state)
            intent = replace(intent, joints=self._grip.follow(arm))
        self._display.show(self._planner, self._plan if self._run else None)
        return intent, replace(outcome, holds=self._grip.held, placed=self._achieved.placed)

    def _step(
        self,
        state: RobotState,
        body: BodyDescription,
        command: ArmCommand | None,
        idle: Idle,
        held: str,
        seen: tuple[SeenSolid, ...],
    ) -> StepResult:
        if command and command.number != self._number:
            self._interrupt()
            self._number = number = command.number
            results = (one for one in self._results if one.number == number)
            self._achieved = next(results, StepOutcome())
            self._misses = self._hold_ups = 0
            self._lookout.reset()
        try:
            planner = self._current_planner(body)
        except GigabrainError as error:
            return self._fail(str(error))
        if self._run:
            self._base_pose = state.pose
        measured = {joint.name for joint in body.joints} <= {joint.name for joint in state.joints}
        arm = ArmReading(planner, body, state) if planner else None
        if arm and measured and not held:
            self._grip.recall(arm)
        if command is None:
            self._interrupt()
            self._lookout.reset()
            return self._still(idle)
        if held:
            self._touch = None
            if self._run:  # a plan in the making stays valid unless the arm is moved
                self._interrupt()
            return self._still(Idle("waiting", f"waiting: {held}"), held=True)
        if arm is None:
            return self._still(NO_MODEL)
        if not measured:
            return self._still(NOT_MEASURED)
        at_thing = self._abandoned and arm.is_at_thing(self._abandoned, self._base_pose)
        if self._run is None and self._abandoned and not at_thing:  # something else moved the arm
            self._abandoned = self._put_down = None
        if self._run is None and self._achieved.number and not self._abandoned:
            return self._still(Idle("done", self._achieved.reason), self._achieved)
        try:
            return self._carry_out(arm, command, seen)
        except GigabrainError as error:  # the thing does not fit, or the arm has no pads
            return self._fail(str(error))

    def close(self) -> None:
        """Stop the worker thread, after its current plan."""
        self._display.close()
        self._pool.shutdown(cancel_futures=True)

    def _current_planner(self, body: BodyDescription) -> ArmPlanner | None:
        """Return the planner for the current body and model; None until it is loaded.

        Raises GigabrainError for a model that cannot be used, until there is another one.
        """
        model = self._models.current
        if model is None:
            return None
        inputs = model.mjcf, body
        if inputs != self._planner_inputs:
            old = self._planner_inputs
            self._interrupt()
            self._planner_inputs, self._planner = inputs, None
            if old is None or (old[0], old[1].joints) != (model.mjcf, body.joints):
                self._abandoned = None
                self._grip.release()
            self._loading = self._pool.submit(ArmPlanner, *inputs)
        if self._planner is None and self._loading and self._in_time(self._loading, 0.0):
            self._planner = self._loading.result()
        return self._planner

    def _carry_out(
        self, arm: ArmReading, command: ArmCommand, seen: tuple[SeenSolid, ...]
    ) -> StepResult:
        still = not (self._run or self._planning or self._grip.moves)
        if still and self._grip.hold and not self._grip.keeps(arm):
            self._let_go(arm) if self._put_down else self._grip.release()
        do, hold = command.do, self._grip.hold
        if isinstance(do, Pick) and self._run is None and hold and hold.thing.name == do.thing:
            self._achieved = self._success(self._grip.text)
            return self._still(Idle("done", self._achieved.reason), self._achieved)
        if hold and still_stands(seen, self._camera_id, arm.state.tick - self._grip.firm_tick):
            self._grip.release()
            return self._fail(f"{hold.thing.name} is not in the gripper: it is seen where it was")
        if isinstance(do, AwaitTaken):
            return self._offer(arm)
        if self._run is None and self._abandoned and not hold:
            self._back_off(arm, self._abandoned)
        elif self._run is None:
            if self._planning is None:
                held, floor = self._camera_id if hold else None, floor_of(arm.body)
                things, numbers = located(command.things, seen, held, floor)
                if self._put and (solid := self._put.at(arm.state, seen)):
                    things[f"{self._put.name} put down"] = solid
                else:
                    self._put = None
                if isinstance(do, Pick) and not hold:
                    self._camera_id = numbers.get(do.thing)
                missing = None if hold else unseen(do, command.things, things)
                if missing:
                    return self._look_for(missing, command, arm, things)
                work = self._work(arm, do, things)
                if isinstance(work, str):
                    return self._fail(work)
                self._planning = self._pool.submit(work)
            if not self._in_time(self._planning, 0.0) or self._grip.moves:
                return self._still(PLANNING)
            planning, self._planning = self._planning, None
            return self._start_plan(planning.result(), arm, command)
        return self._follow(arm, command)

    def _start_plan(self, planned: Planned, arm: ArmReading, command: ArmCommand) -> StepResult:
        """Start to execute a plan; plan again if it is outdated, and fail if there is none."""
        if isinstance(planned, NoWay):
            if self._detour or self._put:  # try without moving aside, and without this obstacle
                self._detour, self._put = False, None
                return self._still(PLANNING)
            return self._fail(planned.reason, approach(self._target, planned.stand_off))
        if not begins_at(planned, arm.sent_posture):
            self._detour = False
            return self._still(PLANNING)
        self._abandoned = None
        self._begin(arm, planned)
        return self._follow(arm, command)

    def _look_for(
        self, name: str, command: ArmCommand, arm: ArmReading, things: Mapping[str, Solid]
    ) -> StepResult:
        """Hold still until a thing is seen; then move the arm aside, as it may hide the thing.

        A body that can drive looks elsewhere for a thing with a label instead.
        """
        if not self._lookout.waits(arm.state.tick):
            elsewhere = (command.things[name].label or "") if arm.body.has_base else ""
            posture = None if elsewhere else self._lookout.aside(arm.body)
            if posture is None:
                return self._fail(f"{name} is not seen", seek=elsewhere)
            work = self._work(arm, TakePosture(posture), things)
            if isinstance(work, str):
                return self._fail(work)
            self._detour, self._planning = True, self._pool.submit(work)
        return self._still(Idle("looking", f"looking for {name}"))

    def _work(
        self, arm: ArmReading, do: ArmAction, things: Mapping[str, Solid]
    ) -> Callable[[], Planned] | str:
        """Return a function that plans an action, or why it cannot be planned."""
        if isinstance(do, Pick) and do.thing in things:
            self._target = thing_of(do.thing, things[do.thing])
        # a thing that has its place from the mission moves along with the body
        drives = arm.body.has_base and self._camera_id is not None
        now = WorkInputs(
            arm=arm, things=things, hold=self._grip.hold, misses=self._misses, drives=drives
        )
        return work_for(do, now)

    def _offer(self, arm: ArmReading) -> StepResult:
        """Hold still until a person pulls at the held thing, or takes it."""
        hold, self._touch = self._grip.hold, self._touch or Touch(arm.planner)
        pulled = self._touch.is_pulled(arm)
        if hold and arm.holds(hold) and not pulled:
            return self._still(Idle("offering", OFFERING.format(hold.thing.name)))
        if not pulled:
            self._grip.release()
        self._achieved = self._success(self._grip.text)
        return self._still(Idle("done", ""), replace(self._achieved, reason=""))

    def _back_off(self, arm: ArmReading, left: Plan) -> None:
        """Start to back off from a thing that is not held; afterwards the arm plans again."""
        self._abandoned, self._detour = left, True
        posture, put_down = arm.sent_posture, left.phases[-1].name == "retreat"
        back = rest_of_place(left, posture) if put_down else arm.planner.back_off(left, posture)
        self._begin(arm, back)

    def _press(self, arm: ArmReading, do: Press, *, over: bool) -> StepResult:
        """Continue to press until the force is reached or the way is `over`; then back off."""
        self._touch = self._touch or Touch(arm.planner)
        pressure = self._touch.pressure(arm)
        if over or (pressure and pressure.reaches(do.force)):
            touched = pressure is not None and pressure.touched
            if touched:
                self._achieved = self._success(str(pressure))
                self._results.append(self._achieved)
            else:
                self._failure = f"nothing was touched up to {do.depth * 100:g} cm behind that place"
            self._abandoned, self._detour = self._plan, True
            hold_s = do.seconds if touched else 0.0
            self._begin(arm, arm.planner.after_press(self._plan, arm.sent_posture, hold_s))
        return self._moving(arm)

    def _begin(self, arm: ArmReading, plan: Plan) -> None:
        gripper = arm.planner.arm.gripper
        self._plan, self._put_down = plan, None
        self._run = PhaseRun(plan.phases, gripper.name if gripper else "", arm.state.tick)
        if self._grip.hold:
            self._grip.make_firm(arm, self._run)

    def _follow(self, arm: ArmReading, command: ArmCommand) -> StepResult:
        """Execute one step of the current plan."""
        run, plan, hold, tick = self._run, self._plan, self._grip.hold, arm.state.tick
        assert run
        if hold and run.phase and run.phase.name in CARRYING and not arm.holds(hold):
            return self._missed(arm)
        waits = run.wait(tick, *pace(arm.body, arm.state))
        if run.waited > WAIT_TICKS:
            return self._held_up(f"{waits} is held back for {WAIT_TICKS * TICK_S:g} s")
        if off := off_from(arm.body, arm.state, run.expected(tick), "path_tolerance"):
            return self._held_up(off)
        grips = run.phase is not None and arm.gripper_moves(run.phase)
        presses = run.phase is not None and run.phase.name == "press"
        over = run.advance(tick, grips=grips)
        if presses and isinstance(command.do, Press):
            return self._press(arm, command.do, over=over is not None)
        if over and over.name == "close" and plan.hold:
            closed = arm.sent_to(plan.hold.grip)  # False if safety holds it back
            if not (closed and arm.holds(plan.hold)):
                return self._missed(arm)
            assert self._target
            hold = arm.planner.gripped(plan.hold, self._target, arm.measured_posture)
            self._grip.take(hold)
            self._achieved = self._success(self._grip.text)
        if over and over.name in ("close", "squeeze") and hold:
            if not arm.holds(hold):
                return self._missed(arm)
            self._grip.make_firm(arm, run)
        if over and over.name == "lower" and hold:
            self._put_down = self._success(placed=placed(arm, command.do, hold))
        if over and over.name == "open" and hold:
            self._let_go(arm)
        if over and over.name == "grip":
            assert over.gripper is not None
            self._grip.close_at(arm, over.gripper)
        if run.phase is None:
            return self._end(arm, run, command.do)
        return self._moving(arm)

    def _missed(self, arm: ArmReading) -> StepResult:
        """Back off from a thing that was not caught; afterwards try another grasp.

        A command that is not a pick fails: it has lost the thing that it moves.
        """
        lost = self._grip.hold
        self._grip.release()
        if lost and self._plan.grasp is None:
            return self._fail(f"{lost.thing.name} has slipped out of the gripper")
        self._misses += 1
        self._achieved = StepOutcome()
        self._back_off(arm, self._plan)
        return self._moving(arm)

    def _held_up(self, why: str) -> StepResult:
        """Plan again from the current posture after a hold-up; fail after too many."""
        self._hold_ups += 1
        if self._hold_ups > HOLD_UPS:
            return self._fail(why)
        self._interrupt()
        return self._still(PLANNING)

    def _let_go(self, arm: ArmReading) -> None:
        """Record that the held thing was put down, maybe by an earlier command."""
        done, self._put_down = self._put_down, None
        assert done
        assert done.placed
        self._grip.release()
        self._results.append(done)
        if done.number == self._number:
            self._achieved = done
        if self._camera_id is not None:  # other things have a place in the mission
            self._put = PutDown(name=done.placed[0], solid=done.placed[1], state=arm.state)

    def _success(self, reason: str = "", placed: tuple[str, Solid] | None = None) -> StepOutcome:
        return StepOutcome(
            number=self._number,
            state="done",
            reason=reason,
            progress=1.0,
            placed=placed,
        )

    def _end(self, arm: ArmReading, run: PhaseRun, do: ArmAction) -> StepResult:
        """End a command after its last phase, once the joints are within their tolerances."""
        assert arm.body.arm
        last = self._plan.phases[-1].arm
        end = dict(zip(last.names, last.positions[-1].tolist(), strict=True)) if last else {}
        if off := off_from(arm.body, arm.state, end, "goal_tolerance"):
            late = run.over_for(arm.state.tick) * TICK_S > arm.body.arm.goal_time
            return self._held_up(off) if late else self._moving(arm)
        if self._detour and not self._achieved.number:
            why = self._failure or (MISSED if self._misses >= TRIES else "")
            self._drop()
            return self._fail(why) if why else self._still(PLANNING)
        if not self._achieved.number:
            text = self._grip.text
            if text and names_gripper(arm.body, do):
                text = f"{text}, {GRIPPER_STAYS}"
            self._achieved = self._success(text)
        self._drop()
        return self._still(Idle("done", self._achieved.reason), self._achieved)

    def _moving(self, arm: ArmReading) -> StepResult:
        assert self._run
        return moving(self._run, arm.state.tick, self._number, self._behaviour)

    def _fail(self, reason: str, approach: Target | None = None, seek: str = "") -> StepResult:
        self._interrupt()
        outcome = StepOutcome(state="failed", reason=reason[:500], approach=approach, seek=seek)
        return self._still(Idle("failed", reason), outcome)

    def _still(
        self, why: Idle, outcome: StepOutcome | None = None, *, held: bool = False
    ) -> StepResult:
        """Return the intent to hold still."""
        reason = why.reason[:500]
        outcome = outcome or StepOutcome(activity=why.activity, reason=reason, held=held)
        intent = Intent(behaviour=self._behaviour, reason=reason)
        return intent, replace(outcome, number=self._number)

    def _interrupt(self) -> None:
        """Drop the plan, but remember it: the hand may be at its thing (`is_at_thing`)."""
        left = self._abandoned or (self._plan if self._run else None)
        self._drop()
        self._abandoned = left

    def _drop(self) -> None:
        """Drop the current plan, and the one in the making."""
        if self._planning:
            self._planning.cancel()
        self._planning = self._run = self._abandoned = self._touch = None
        self._detour, self._failure = False, ""
