"""Moves the arm: plans each command in a worker thread, and carries it out from tick to tick."""

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
    begins_at,
    gripper_moves,
    holds,
    is_at,
    measured_posture,
    off_from,
    pace,
    rest_of_place,
    sent_posture,
    sent_to,
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

TRIES = 3  # to pick a thing up, each with another grasp
HOLD_UPS = 5  # of one command, after which it fails
MAX_RESULTS = 64  # that are kept
WAIT_TICKS = 100  # for a joint that the gate holds back, before another way is planned
MISSED = f"it was not caught, {TRIES} times"
CARRYING = ("lift", "traverse", "lower", "move")  # phases in which a thing has to be held
NO_MODEL = Idle("waiting", "waiting: for the arm's model, robot/arm_model")
NOT_MEASURED = Idle("waiting", "waiting: for all joints to be measured")
PLANNING = Idle("planning", "planning")
OFFERING = "waiting for somebody to pull at {}; `gigabrain task resume` lets go of it"
GRIPPER_STAYS = "so the gripper stays; `place` and `gripper` let go of it"


class Manipulator:
    """Carries out one command for the arm at a time."""

    def __init__(self, bus: Bus, behaviour: str, held: Held | None = None) -> None:
        """Prepare for an arm; `held` is what its gripper held before a restart."""
        self._behaviour, self._in_time = behaviour, bus.input_log.in_time
        self._models, self._display = bus.latest(ARM_MODEL), PlanDisplay(bus)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="arm")
        self._made_for: tuple[str, BodyDescription] | None = None
        self._making: Future[ArmPlanner] | None = None
        self._planner: ArmPlanner | None = None
        self._planning: Future[Planned] | None = None
        self._plan = Plan(phases=())
        self._run: PhaseRun | None = None
        self._grip = Grip(held)
        self._number = 0  # of the present command, or of the last one
        self._misses = 0  # grasps of it that caught nothing
        self._hold_ups = 0  # of it, by a joint that did not follow
        self._achieved = StepOutcome()  # of a command that is done but for the way back
        # the same of earlier commands, which go on after a task that came first
        self._results: deque[StepOutcome] = deque(maxlen=MAX_RESULTS)
        self._put_down: StepOutcome | None = None  # of the command whose thing is being let go of
        self._left: Plan | None = None  # that was cut short: the hand may still be at its thing
        self._base = Pose(x=0.0, y=0.0, yaw=0.0)  # of the body when the arm moved last
        self._interim = False  # it goes back from there, or out of a camera's sight
        self._why_not = ""  # why it fails once it is back
        self._touch: Touch | None = None  # while it presses, or offers something
        self._lookout = Lookout()
        self._seen_as: int | None = None  # number by which a camera knew what is held
        self._target: Thing | None = None  # to be picked up, where it stands
        self._put: PutDown | None = None  # what a camera knew, and has not seen since

    def step(
        self,
        state: RobotState,
        body: BodyDescription,
        command: ArmCommand | None,
        idle: Idle,
        held: str,
        seen: tuple[SeenSolid, ...] = (),
    ) -> StepResult:
        """Carry out `command` for one step, or hold still as `idle` says.

        While the body does not follow, as `held` says, the arm holds; it plans again afterwards.
        Things without a place are where they are `seen`, in the body's frame.
        """
        intent, outcome = self._step(state, body, command, idle, held, seen)
        if self._planner and not self._run and not held:
            intent = replace(intent, joints=self._grip.follow(self._planner, body, state))
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
            planner = self._ready(body)
        except GigabrainError as error:
            return self._fail(str(error))
        if self._run:
            self._base = state.pose
        measured = {joint.name for joint in body.joints} <= {joint.name for joint in state.joints}
        if planner and measured and not held:
            self._grip.recall(planner, body, state)
        if command is None:
            self._interrupt()
            self._lookout.reset()
            return self._still(idle)
        if held:
            self._touch = None
            if self._run:  # a plan that is being made will do, if the arm has not been moved then
                self._interrupt()
            return self._still(Idle("waiting", f"waiting: {held}"), held=True)
        if planner is None:
            return self._still(NO_MODEL)
        if not measured:
            return self._still(NOT_MEASURED)
        near = self._left and is_at(self._left, self._base, planner, body, state)
        if self._run is None and self._left and not near:  # the base, or an operator, has moved it
            self._left = self._put_down = None
        if self._run is None and self._achieved.number and not self._left:
            return self._still(Idle("done", self._achieved.reason), self._achieved)
        try:
            return self._carry_out(planner, state, body, command, seen)
        except GigabrainError as error:  # a thing that does not fit, or an arm without pads
            return self._fail(str(error))

    def close(self) -> None:
        """Stop the worker thread, after the plan that it makes."""
        self._display.close()
        self._pool.shutdown(cancel_futures=True)

    def _ready(self, body: BodyDescription) -> ArmPlanner | None:
        """Return the planner of the present body and model, once there is one."""
        model = self._models.current
        if model is None:
            return None
        wanted = model.mjcf, body
        if wanted != self._made_for:
            known = self._made_for
            self._interrupt()
            self._made_for, self._planner = wanted, None
            if known is None or (known[0], known[1].joints) != (model.mjcf, body.joints):
                self._left = None
                self._grip.release()
            self._making = self._pool.submit(ArmPlanner, *wanted)
        if self._planner is None and self._making and self._in_time(self._making, 0.0):
            self._planner = self._making.result()  # raises as long as there is no other model
        return self._planner

    def _carry_out(
        self,
        planner: ArmPlanner,
        state: RobotState,
        body: BodyDescription,
        command: ArmCommand,
        seen: tuple[SeenSolid, ...],
    ) -> StepResult:
        still = not (self._run or self._planning or self._grip.moves)
        if still and self._grip.hold and not self._grip.keeps(planner, body, state):
            self._let_go(state) if self._put_down else self._grip.release()
        do, hold = command.do, self._grip.hold
        if isinstance(do, Pick) and self._run is None and hold and hold.thing.name == do.thing:
            self._achieved = self._success(self._grip.text)
            return self._still(Idle("done", self._achieved.reason), self._achieved)
        if hold and still_stands(seen, self._seen_as, state.tick - self._grip.firm_tick):
            self._grip.release()
            return self._fail(f"{hold.thing.name} is not in the gripper: it is seen where it was")
        if isinstance(do, AwaitTaken):
            return self._offer(planner, body, state)
        if self._run is None and self._left and not hold:
            self._back_off(planner, body, state, self._left)
        elif self._run is None:
            if self._planning is None:
                held, floor = self._seen_as if hold else None, floor_of(body)
                things, numbers = located(command.things, seen, held, floor)
                if self._put and (solid := self._put.at(state, seen)):
                    things[f"{self._put.name} put down"] = solid
                else:
                    self._put = None
                if isinstance(do, Pick) and not hold:
                    self._seen_as = numbers.get(do.thing)
                missing = None if hold else unseen(do, command.things, things)
                if missing:
                    return self._look_for(missing, command, planner, state, body, things)
                work = self._work(planner, state, body, do, things)
                if isinstance(work, str):
                    return self._fail(work)
                self._planning = self._pool.submit(work)
            if not self._in_time(self._planning, 0.0) or self._grip.moves:
                return self._still(PLANNING)
            planning, self._planning = self._planning, None
            return self._take_up(planning.result(), planner, state, body, command)
        return self._follow(planner, state, body, command)

    def _take_up(
        self,
        found: Planned,
        planner: ArmPlanner,
        state: RobotState,
        body: BodyDescription,
        command: ArmCommand,
    ) -> StepResult:
        """Begin to carry out what was planned, unless it has to be planned again, or cannot be."""
        if isinstance(found, NoWay):
            if self._interim or self._put:  # it stays in sight, or less is in its way
                self._interim, self._put = False, None
                return self._still(PLANNING)
            return self._fail(found.reason, approach(self._target, found.stand_off))
        if not begins_at(found, sent_posture(planner, body, state)):
            self._interim = False
            return self._still(PLANNING)
        self._left = None
        self._begin(planner, found, state)
        return self._follow(planner, state, body, command)

    def _look_for(
        self,
        name: str,
        command: ArmCommand,
        planner: ArmPlanner,
        state: RobotState,
        body: BodyDescription,
        things: Mapping[str, Solid],
    ) -> StepResult:
        """Hold still until a thing is seen, or begin to move the arm out of sight.

        A body that can drive looks for it elsewhere instead.
        """
        if not self._lookout.waits(state.tick):
            elsewhere = (command.things[name].label or "") if body.has_base else ""
            posture = None if elsewhere else self._lookout.aside(body)
            if posture is None:
                return self._fail(f"{name} is not seen", seek=elsewhere)
            work = self._work(planner, state, body, TakePosture(posture), things)
            if isinstance(work, str):
                return self._fail(work)
            self._interim, self._planning = True, self._pool.submit(work)
        return self._still(Idle("looking", f"looking for {name}"))

    def _work(
        self,
        planner: ArmPlanner,
        state: RobotState,
        body: BodyDescription,
        do: ArmAction,
        things: Mapping[str, Solid],
    ) -> Callable[[], Planned] | str:
        """Return what plans an action, or why it cannot be planned."""
        if isinstance(do, Pick) and do.thing in things:
            self._target = thing_of(do.thing, things[do.thing])
        drives = body.has_base and self._seen_as is not None  # others do not stay behind
        now = WorkInputs(
            state=state, body=body, things=things, hold=self._grip.hold, misses=self._misses,
            drives=drives,
        )  # fmt: skip
        return work_for(planner, do, now)

    def _offer(self, planner: ArmPlanner, body: BodyDescription, state: RobotState) -> StepResult:
        """Hold still until somebody pulls at what the gripper holds, or has taken it."""
        hold, self._touch = self._grip.hold, self._touch or Touch(planner)
        pulled = self._touch.is_pulled(body, state)
        if hold and holds(planner, hold, state) and not pulled:
            return self._still(Idle("offering", OFFERING.format(hold.thing.name)))
        if not pulled:
            self._grip.release()
        self._achieved = self._success(self._grip.text)
        return self._still(Idle("done", ""), replace(self._achieved, reason=""))

    def _back_off(
        self, planner: ArmPlanner, body: BodyDescription, state: RobotState, left: Plan
    ) -> None:
        """Begin to go back from a thing that is not held; afterwards it is planned again."""
        self._left, self._interim = left, True
        posture, put_down = sent_posture(planner, body, state), left.phases[-1].name == "retreat"
        back = rest_of_place(left, posture) if put_down else planner.back_off(left, posture)
        self._begin(planner, back, state)

    def _press(
        self, planner: ArmPlanner, body: BodyDescription, state: RobotState, do: Press, over: bool
    ) -> StepResult:
        """Go on to press, until it is felt enough or the way is `over`; then go back."""
        self._touch = self._touch or Touch(planner)
        pressure = self._touch.pressure(body, state)
        if over or (pressure and pressure.reaches(do.force)):
            touched = pressure is not None and pressure.touched
            if touched:
                self._achieved = self._success(str(pressure))
                self._results.append(self._achieved)
            else:
                self._why_not = f"nothing was touched, {do.depth * 100:g} cm behind that place"
            self._left, self._interim = self._plan, True
            posture = sent_posture(planner, body, state)
            back = planner.after_press(self._plan, posture, do.seconds if touched else 0.0)
            self._begin(planner, back, state)
        return self._moving(state)

    def _begin(self, planner: ArmPlanner, plan: Plan, state: RobotState) -> None:
        gripper = planner.arm.gripper
        self._plan, self._put_down = plan, None
        self._run = PhaseRun(plan.phases, gripper.name if gripper else "", state.tick)
        if self._grip.hold:
            self._grip.make_firm(planner, self._run, state)

    def _follow(
        self, planner: ArmPlanner, state: RobotState, body: BodyDescription, command: ArmCommand
    ) -> StepResult:
        """Go on with the present plan by one step."""
        run, plan, hold = self._run, self._plan, self._grip.hold
        assert run
        if hold and run.phase and run.phase.name in CARRYING and not holds(planner, hold, state):
            return self._missed(planner, body, state)
        waits = run.wait(state.tick, *pace(body, state))
        if run.waited > WAIT_TICKS:
            return self._held_up(f"{waits} is held back for {WAIT_TICKS * TICK_S:g} s")
        if off := off_from(body, state, run.expected(state.tick), "path_tolerance"):
            return self._held_up(off)
        grips = run.phase is not None and gripper_moves(planner, state, body, run.phase)
        presses = run.phase is not None and run.phase.name == "press"
        over = run.advance(state.tick, grips=grips)
        if presses and isinstance(command.do, Press):
            return self._press(planner, body, state, command.do, over is not None)
        if over and over.name == "close" and plan.hold:
            closed = sent_to(planner, body, state, plan.hold.grip)  # unless safety holds it back
            if not (closed and holds(planner, plan.hold, state)):
                return self._missed(planner, body, state)
            assert self._target
            posture = measured_posture(planner, state)
            self._grip.take(hold := planner.gripped(plan.hold, self._target, posture))
            self._achieved = self._success(self._grip.text)
        if over and over.name in ("close", "squeeze") and hold:
            if not holds(planner, hold, state):
                return self._missed(planner, body, state)
            self._grip.make_firm(planner, run, state)
        if over and over.name == "lower" and hold:
            thing = placed(planner, measured_posture(planner, state), command.do, hold, body)
            self._put_down = self._success(placed=thing)
        if over and over.name == "open" and hold:
            self._let_go(state)
        if over and over.name == "grip":
            assert over.gripper is not None
            self._grip.close_at(planner, state, over.gripper)
        if run.phase is None:
            return self._end(body, state, run, command.do)
        return self._moving(state)

    def _missed(self, planner: ArmPlanner, body: BodyDescription, state: RobotState) -> StepResult:
        """Go back from a thing that was not caught; afterwards another grasp is tried.

        A command that does not pick fails: what it moves was held before, and is lost.
        """
        lost = self._grip.hold
        self._grip.release()
        if lost and self._plan.grasp is None:
            return self._fail(f"{lost.thing.name} has slipped out of the gripper")
        self._misses += 1
        self._achieved = StepOutcome()
        self._back_off(planner, body, state, self._plan)
        return self._moving(state)

    def _held_up(self, why: str) -> StepResult:
        """Plan again from where the joints are, as something held them up."""
        self._hold_ups += 1
        if self._hold_ups > HOLD_UPS:
            return self._fail(why)
        self._interrupt()
        return self._still(PLANNING)

    def _let_go(self, state: RobotState) -> None:
        """Record that what was held has been put down, maybe by an earlier command."""
        done, self._put_down = self._put_down, None
        assert done
        assert done.placed
        self._grip.release()
        self._results.append(done)
        if done.number == self._number:
            self._achieved = done
        if self._seen_as is not None:  # others have a place by their mission
            self._put = PutDown(name=done.placed[0], solid=done.placed[1], state=state)

    def _success(self, reason: str = "", placed: tuple[str, Solid] | None = None) -> StepOutcome:
        return StepOutcome(
            number=self._number,
            state="done",
            reason=reason,
            progress=1.0,
            placed=placed,
        )

    def _end(
        self, body: BodyDescription, state: RobotState, run: PhaseRun, do: ArmAction
    ) -> StepResult:
        """End a command whose phases are over, once the joints are where they should be."""
        assert body.arm
        last = self._plan.phases[-1].arm
        end = dict(zip(last.names, last.positions[-1].tolist(), strict=True)) if last else {}
        if off := off_from(body, state, end, "goal_tolerance"):
            late = run.over_for(state.tick) * TICK_S > body.arm.goal_time
            return self._held_up(off) if late else self._moving(state)
        if self._interim and not self._achieved.number:
            why = self._why_not or (MISSED if self._misses >= TRIES else "")
            self._drop()
            return self._fail(why) if why else self._still(PLANNING)
        if not self._achieved.number:
            text = self._grip.text
            if text and names_gripper(body, do):
                text = f"{text}, {GRIPPER_STAYS}"
            self._achieved = self._success(text)
        self._drop()
        return self._still(Idle("done", self._achieved.reason), self._achieved)

    def _moving(self, state: RobotState) -> StepResult:
        assert self._run
        return moving(self._run, state.tick, self._number, self._behaviour)

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
        """Forget the plan, but not that the hand may be at its thing; see `is_at`."""
        left = self._left or (self._plan if self._run else None)
        self._drop()
        self._left = left

    def _drop(self) -> None:
        """Forget the plan, and the one that is being made."""
        if self._planning:
            self._planning.cancel()
        self._planning = self._run = self._left = self._touch = None
        self._interim, self._why_not = False, ""
