"""Supplements of a model in Python: what `<numeric name="phantom:KIND:ELEMENT" .../>` of a model file adds to MuJoCo.

docs/supplement.md says what each kind does; this does the same as the program, with the official package:

    import mujoco
    from phantom_supplement import Supplement

    model = mujoco.MjModel.from_xml_path("repaired.xml")
    data = mujoco.MjData(model)
    supplement = Supplement(model)        # does nothing where the model names none
    supplement.step(data)                 # instead of mujoco.mj_step(model, data)
    supplement.inverse(data)              # instead of mujoco.mj_inverse(model, data)
    supplement.encoder(data, joint)       # what an encoder shows: position and velocity

`data.ctrl` holds commands, before and after a step. Sensors in `data.sensordata` are as the machine's. What a supplement
remembers from step to step is `supplement.memory`; `reset()` clears it, a copy of it belongs to a copy of the state.
"""
import math

import mujoco
import numpy as np

PREFIX = "phantom:"
MAX_DELAY_S = 0.05
# what flanks of a play give back of a motor's speed, flights in a step, and what part of a step is none
REBOUND, FLIGHTS, BRIEF = 0.45, 16, 0.01
# kinds in the order in which they act, with what the element is and how many numbers it has
KINDS = {
    "actuator_delay": ("actuator", 1), "actuator_lag": ("actuator", 1), "torque_ripple": ("actuator", 3),
    "backlash": ("actuator", 1), "transmission_compliance": ("actuator", 2),
    "asymmetric_friction": ("joint", 1), "stribeck_friction": ("joint", 2), "load_dependent_friction": ("joint", 1),
    "quadratic_drag": ("joint", 1), "torque_offset": ("joint", 1), "cogging": ("joint", 3), "joint_stop": ("joint", 4),
    "torsional_friction": ("contact", 2), "encoder_scale": ("joint", 1), "encoder_offset": ("joint", 1),
    "sensor_delay": ("encoders", 1), "force_sensor_bias": ("sensor", 3),
}
SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


class Line:
    """Past values: how many there are, where the next goes, the values."""

    @staticmethod
    def length(timestep, width):
        return 2 + width * (math.ceil(MAX_DELAY_S / timestep) + 2)

    @staticmethod
    def before(memory, now, steps, width, i):
        """Number `i` of those of `width`, `steps` (not whole) before `now`."""
        filled, head, values = int(memory[0]), int(memory[1]), memory[2:]
        n = len(values) // width

        def past(back):
            back = min(back, filled)
            return now if back == 0 else values[width * ((head + n - back) % n) + i]

        whole = math.floor(steps)
        part = steps - whole
        return past(whole) if part == 0 else (1 - part) * past(whole) + part * past(whole + 1)

    @staticmethod
    def push(memory, row):
        n, head = (len(memory) - 2) // len(row), int(memory[1])
        memory[2 + len(row) * head:2 + len(row) * (head + 1)] = row
        memory[0] = min(memory[0] + 1, n)
        memory[1] = (head + 1) % n


class Term:
    """One custom element: where it acts, where its numbers and its part of the memory are."""

    def __init__(self, model, name, first):
        self.kind, self.element = name[len(PREFIX):].split(":", 1)
        place, count = KINDS[self.kind]
        self.numbers = slice(first, first + count)
        self.joint = self.dof = self.qpos = self.actuator = self.sensor = self.geoms = None
        self.memory = slice(0, 0)

        def find(kind):
            return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), self.element)

        if place == "actuator":
            self.actuator = find("actuator")
            if self.kind != "actuator_delay" and self.kind != "actuator_lag":
                self.joint = int(model.actuator_trnid[self.actuator][0])
        elif place == "joint":
            self.joint = find("joint")
        elif place == "sensor":
            self.sensor = find("sensor")
        elif place == "contact":
            pair = find("pair")
            self.geoms = (find("geom"), None) if pair < 0 else (model.pair_geom1[pair], model.pair_geom2[pair])
        if self.joint is not None:
            self.qpos, self.dof = int(model.jnt_qposadr[self.joint]), int(model.jnt_dofadr[self.joint])

    def memory_length(self, timestep, n_joint):
        return {"actuator_delay": Line.length(timestep, 1), "actuator_lag": 2, "backlash": 4,
                "transmission_compliance": 4, "torsional_friction": 1,
                "sensor_delay": Line.length(timestep, 2 * n_joint)}.get(self.kind, 0)


class Supplement:
    """All supplements of a model."""

    def __init__(self, model):
        self.model = model
        self.terms = []
        for i in range(model.nnumeric):
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_NUMERIC, i) or ""
            if not name.startswith(PREFIX):
                continue
            kind, _, element = name[len(PREFIX):].partition(":")
            if kind not in KINDS or not element or model.numeric_size[i] != KINDS[kind][1]:
                raise ValueError(f"custom element {name}: not a supplement, see docs/supplement.md")
            self.terms.append(Term(model, name, int(model.numeric_adr[i])))
        self.terms.sort(key=lambda term: list(KINDS).index(term.kind))
        self.scalar = [j for j in range(model.njnt) if model.jnt_type[j] in SCALAR]
        self._lay_out()

    def _lay_out(self):
        self.timestep, first = self.model.opt.timestep, 0
        for term in self.terms:
            end = first + term.memory_length(self.timestep, len(self.scalar))
            term.memory, first = slice(first, end), end
        self.memory = np.zeros(first)
        self.next = np.zeros(first)

    def reset(self):
        """Forgets everything, and follows a change of the time step."""
        self._lay_out()

    # ------------------------------------------------------------------------------------------- computations

    def step(self, data):
        """mj_step."""
        if not self.terms:
            mujoco.mj_step(self.model, data)
            return
        self.step1(data)
        self.step2(data)

    def step1(self, data):
        """mj_step1."""
        mujoco.mj_step1(self.model, data)
        if self.terms:
            self._after_velocity(data)

    def step2(self, data):
        """mj_step2."""
        if not self.terms:
            mujoco.mj_step2(self.model, data)
            return
        restore = self._prepare(data, inverse=False)
        mujoco.mj_step2(self.model, data)
        self._conclude(data, restore)
        self.advance()

    def forward(self, data):
        """mj_forward; no time passes."""
        if not self.terms:
            mujoco.mj_forward(self.model, data)
            return
        self._stages(data)
        restore = self._prepare(data, inverse=False)
        mujoco.mj_forwardSkip(self.model, data, int(mujoco.mjtStage.mjSTAGE_VEL), 0)
        self._conclude(data, restore)

    def inverse(self, data):
        """mj_inverse; qfrc_actuator is left as from the commands in ctrl."""
        if not self.terms:
            mujoco.mj_inverse(self.model, data)
            return
        self._stages(data)
        restore = self._prepare(data, inverse=True)
        mujoco.mj_inverseSkip(self.model, data, int(mujoco.mjtStage.mjSTAGE_VEL), 0)
        self._conclude(data, restore)

    def advance(self):
        """Remembers the last forward or inverse as the step that ends now; steps do so by themselves."""
        self.memory[:] = self.next

    def encoder(self, data, joint):
        """Position and velocity that the encoder of a hinge or slide shows."""
        return self._encoder(data, joint, self.terms)

    # ------------------------------------------------------------------------------------------------- inside

    def _stages(self, data):
        mujoco.mj_fwdPosition(self.model, data)
        mujoco.mj_sensorPos(self.model, data)
        mujoco.mj_fwdVelocity(self.model, data)
        mujoco.mj_sensorVel(self.model, data)
        self._after_velocity(data)

    def _after_velocity(self, data):
        self.own_passive = np.array(data.qfrc_passive)
        read = [term for term in self.terms if KINDS[term.kind][0] in ("joint", "encoders")
                and term.kind in ("encoder_scale", "encoder_offset", "sensor_delay")
                or term.kind in ("backlash", "transmission_compliance")]
        model = self.model
        for sensor in range(model.nsensor):
            kind = model.sensor_type[sensor]
            which = {mujoco.mjtSensor.mjSENS_JOINTPOS: 0, mujoco.mjtSensor.mjSENS_JOINTVEL: 1}.get(kind)
            if which is None:
                continue
            joint = int(model.sensor_objid[sensor])
            if any(term.kind == "sensor_delay" or term.joint == joint for term in read):
                data.sensordata[model.sensor_adr[sensor]] = self.encoder(data, joint)[which]

    def _prepare(self, data, inverse):
        model = self.model
        self.next[:] = self.memory
        commands, xfrc = np.array(data.ctrl), np.array(data.xfrc_applied)
        for term in self.terms:
            self._command(term, data)
        mujoco.mj_fwdActuation(model, data)
        passive, friction, torque = np.zeros(model.nv), np.zeros(model.nv), np.zeros((model.nbody, 3))
        for i, term in enumerate(self.terms):
            self._force(term, data, passive, friction, torque)
            if term.kind == "sensor_delay":
                shown = [self._encoder(data, joint, self.terms[:i]) for joint in self.scalar]
                Line.push(self.next[term.memory], np.ravel(shown))
        for body in np.flatnonzero(torque.any(axis=1)):
            data.xfrc_applied[body, 3:] += torque[body]
            if inverse:
                mujoco.mj_applyFT(model, data, np.zeros(3), torque[body], np.zeros(3), body, passive)
        data.qfrc_passive[:] = self.own_passive + passive
        for row in range(data.ne, data.ne + data.nf):
            if data.efc_type[row] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF:
                dof = data.efc_id[row]
                data.efc_frictionloss[row] = max(model.dof_frictionloss[dof] + friction[dof], 0)
        return commands, xfrc

    def _conclude(self, data, restore):
        data.ctrl[:], data.xfrc_applied[:] = restore
        model, force = self.model, np.zeros(6)
        for term in self.terms:
            if term.kind == "torsional_friction":
                total = 0.0
                for i in self._contacts(term, data):
                    mujoco.mj_contactForce(model, data, i, force)
                    total += force[0]
                self.next[term.memory] = total
            elif term.kind == "force_sensor_bias":
                first = model.sensor_adr[term.sensor]
                data.sensordata[first:first + 3] += model.numeric_data[term.numbers]

    def _limited(self, actuator, command):
        clamps = not self.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        if clamps and self.model.actuator_ctrllimited[actuator]:
            low, high = self.model.actuator_ctrlrange[actuator]
            return min(max(command, low), high)
        return command

    def _command(self, term, data):
        number, memory, next_ = self.model.numeric_data[term.numbers], self.memory[term.memory], self.next[term.memory]
        u, h = term.actuator, self.timestep
        if term.kind not in ("actuator_delay", "actuator_lag", "torque_ripple"):
            return
        command = self._limited(u, data.ctrl[u])
        if term.kind == "actuator_delay":
            if number[0] > 0:
                data.ctrl[u] = Line.before(memory, command, min(number[0], MAX_DELAY_S) / h, 1, 0)
            Line.push(next_, [command])
        elif term.kind == "actuator_lag":
            x = memory[1] if memory[0] else command
            kept = math.exp(-h / number[0]) if number[0] > 0 else 0.0
            if number[0] > 0:
                data.ctrl[u] = command + (x - command) * (1 - kept) / (h / number[0])
            next_[:] = 1, command + (x - command) * kept
        else:
            angle = number[2] * data.qpos[term.qpos]
            data.ctrl[u] = command * (1 + number[0] * math.sin(angle) + number[1] * math.cos(angle))

    def _force(self, term, data, passive, friction, torque):
        number, kind, dof = self.model.numeric_data[term.numbers], term.kind, term.dof
        q, v = (data.qpos[term.qpos], data.qvel[dof]) if term.joint is not None else (0.0, 0.0)
        if kind in ("backlash", "transmission_compliance"):
            inertia, next_ = self.model.dof_armature[dof], self.next[term.memory]
            before, after, begun = self._motor(term, data, number, inertia)
            passive[dof] -= inertia * (after[1] - before[1]) / self.timestep
            next_[:] = begun, after[0], after[1], v
        elif kind == "asymmetric_friction":
            level = self.model.dof_frictionloss[dof]
            forwards, backwards = max(level + number[0], 0), max(level - number[0], 0)
            friction[dof] += 0.5 * (forwards + backwards) - level
            passive[dof] -= 0.5 * (forwards - backwards)
        elif kind == "stribeck_friction":
            friction[dof] += number[0] * math.exp(-(v / number[1]) ** 2)
        elif kind == "load_dependent_friction":
            friction[dof] += number[0] * abs(data.qfrc_actuator[dof])
        elif kind == "quadratic_drag":
            passive[dof] -= number[0] * v * abs(v)
        elif kind == "torque_offset":
            passive[dof] += number[0]
        elif kind == "cogging":
            passive[dof] += number[0] * math.sin(number[2] * q) + number[1] * math.cos(number[2] * q)
        elif kind == "joint_stop":
            side = math.copysign(1, number[2])
            depth = side * (q - number[1])
            if depth > 0:
                passive[dof] -= side * max(number[0] * depth + number[3] * side * v, 0)
        elif kind == "torsional_friction":
            contacts = list(self._contacts(term, data))
            for i in contacts:
                contact = data.contact[i]
                normal = np.array(contact.frame[:3])
                first, second = (int(self.model.geom_bodyid[g]) for g in (contact.geom1, contact.geom2))
                spin = normal @ (data.cvel[second][:3] - data.cvel[first][:3])
                share = self.memory[term.memory][0] / len(contacts)
                moment = -number[0] * share * math.tanh(spin / number[1])
                torque[second] += moment * normal
                torque[first] -= moment * normal

    def _motor(self, term, data, number, inertia):
        """Where a motor stands from its joint and how fast it moves from it, before and after the step; 2 if it met a flank, else 1."""
        memory, h = self.memory[term.memory], self.timestep
        moment = np.reshape(data.actuator_moment, (self.model.nu, -1))[term.actuator][term.dof]
        force = data.actuator_force[term.actuator] * moment
        begun = memory[0] != 0
        drive = force - inertia * ((data.qvel[term.dof] - memory[3]) / h if memory[0] == 1 else 0.0)
        if term.kind == "transmission_compliance":
            before = (memory[1], memory[2]) if begun else (number[0] * force, 0.0)
            return before, stretched(before, number[0], number[1], inertia, drive, h), 1
        half = 0.5 * number[0]
        end = math.copysign(half, force) if force else 0.0
        before = (memory[1], memory[2]) if begun else (end, 0.0)
        if inertia > 0:
            after, met = between_stops(before, half, drive / inertia, h)
            return before, after, 2 if met else 1
        return before, (end if force else before[0], 0.0), 1

    def _encoder(self, data, joint, terms):
        shown = [data.qpos[self.model.jnt_qposadr[joint]], data.qvel[self.model.jnt_dofadr[joint]]]
        for term in terms:
            number, memory = self.model.numeric_data[term.numbers], self.memory[term.memory]
            if term.kind == "sensor_delay" and number[0] > 0:
                width, steps = 2 * len(self.scalar), min(number[0], MAX_DELAY_S) / self.timestep
                first = 2 * self.scalar.index(joint)
                shown = [Line.before(memory, now, steps, width, first + i) for i, now in enumerate(shown)]
            elif term.joint != joint:
                continue
            elif term.kind in ("backlash", "transmission_compliance"):
                shown = [shown[0] + memory[1], shown[1] + memory[2]]
            elif term.kind == "encoder_scale":
                shown = [x * (1 + number[0]) for x in shown]
            elif term.kind == "encoder_offset":
                shown = [shown[0] + number[0], shown[1]]
        return shown

    def _contacts(self, term, data):
        geom, other = term.geoms
        for i in range(data.ncon):
            pair = (data.contact[i].geom1, data.contact[i].geom2)
            ours = geom in pair if other is None else pair in ((geom, other), (other, geom))
            if ours and data.contact[i].efc_address >= 0:
                yield i


def stretched(motor, compliance, damping, inertia, torque, time):
    """A motor on a spring, driven evenly for a time."""
    if compliance == 0:
        return 0.0, 0.0
    rest = compliance * torque
    if inertia <= 0:
        return rest, (rest - motor[0]) / time
    frequency = 1 / math.sqrt(compliance * inertia)
    decay, turn = damping * frequency, frequency * math.sqrt(1 - damping * damping)
    sin, cos, shrink = math.sin(turn * time), math.cos(turn * time), math.exp(-decay * time)
    x, v = motor[0] - rest, motor[1]
    return (rest + shrink * (x * cos + (v + decay * x) / turn * sin),
            shrink * (v * cos - (decay * v + frequency * frequency * x) / turn * sin))


def between_stops(motor, half, acceleration, time):
    """A motor between stops at +-half, accelerated evenly for a time, and whether it met one."""
    if half == 0:
        return (0.0, 0.0), False
    (s, v), met = motor, False
    brief = BRIEF * time
    for _ in range(FLIGHTS):
        if v == 0 and abs(s) >= half and s * acceleration >= 0:
            return (math.copysign(half, s), 0.0), met
        meeting = first_meeting(s, v, acceleration, half)
        if meeting is None or meeting[0] >= time:
            return (min(max(s + (v + 0.5 * acceleration * time) * time, -half), half), v + acceleration * time), met
        t, side = meeting
        push, v = side * acceleration, -REBOUND * (v + acceleration * t)
        if push > 0 and 2 * abs(v) / push < brief:
            v = 0.0
        time, s, met = time - t, side * half, True
    return (s, v), met


def first_meeting(s, v, a, half):
    """When and at which end s + v t + a t^2/2 meets +-half."""
    first = None
    for side in (1.0, -1.0):
        gap, u, b = half - side * s, side * v, side * a
        root = u * u + 2 * b * gap
        if root < 0:
            continue
        if u >= 0:
            t = 2 * gap / (u + math.sqrt(root)) if u + root > 0 else math.nan
        elif b > 0:
            t = (math.sqrt(root) - u) / b
        else:
            continue
        if t >= 0 and (first is None or t < first[0]):
            first = (t, side)
    return first
