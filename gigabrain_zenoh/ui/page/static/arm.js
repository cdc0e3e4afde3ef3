// The joints of an arm: their positions, and buttons that move a joint while they are held.
import { makeElement, setText } from './panels.js'

const PERIOD_MS = 40
const MAX_TOOL_SPEED = 0.3 // [m/s]
const AXES = ['x', 'y', 'z'] // of the base
const MIN_MOVING_SPEED = 0.05 // [rad/s] or [m/s]
const LIMP = 'limp: the arm may fall; “Hold” holds it'

/** Return the position or the speed of a joint as text: in degrees, or in millimetres for a sliding joint. */
function inUnit(joint, value, suffix = '') {
  const [factor, unit] = joint.unit === 'm' ? [1000, ' mm'] : [180 / Math.PI, '°']
  return `${(value * factor).toFixed(1)}${unit}${suffix}`
}

function activity(state) {
  if (!state) return 'silent'
  if (state.limp) return LIMP
  return state.joints.some(({ velocity }) => Math.abs(velocity) > MIN_MOVING_SPEED) ? 'moving' : 'held'
}

/** Return the tool's place as text: x, y, z in centimetres, and its pitch. */
export function toolText(tool) {
  if (!tool) return ''
  const [x, y, z, pitch] = tool, down = (pitch * 180) / Math.PI
  const place = [x, y, z].map((metres) => (100 * metres).toFixed(1)).join(', ')
  return `tool at ${place} cm, ${Math.abs(down).toFixed(0)}° ${down < 0 ? 'up' : 'down'}`
}

/** The buttons that hold an arm and let it go limp. The second one asks for confirmation. */
export class ArmHold {
  /** `request(what, more)` sends a request. The other arguments are elements: buttons, and the question `ask` with its answers. */
  constructor({ hold, limp, ask, yes, no, request }) {
    Object.assign(this, { hold, limp, ask })
    hold.addEventListener('click', () => request('hold'))
    limp.addEventListener('click', () => { ask.hidden = false; no.focus() })
    no.addEventListener('click', () => { ask.hidden = true })
    yes.addEventListener('click', () => { ask.hidden = true; request('limp', { value: 'yes' }) })
  }

  /** Enable the buttons that have an effect in this state; without a state, none. */
  setState(state) {
    const mode = state?.gate.mode, shut = mode === 'idle' || mode === 'latched'
    this.hold.disabled = !(state?.limp ? shut : mode === 'enabled')
    this.limp.disabled = !shut || state.limp
    this.hold.title = state?.limp ? 'Hold the joints where they are' : 'Take the arm from the brain, and hold it'
    this.limp.title = mode === 'enabled' ? 'Press STOP first' : 'Switch the motors off, to move the arm by hand'
    if (this.limp.disabled) this.ask.hidden = true
  }
}

export class Arm {
  #joints = []
  #rows = new Map() // by joint
  #held = new Map() // by held button: a joint or an axis of the tool, and the direction, 1 or -1
  #sent = [] // values of `held` at the last command

  /** `send(speeds, tool)` sends speeds of joints and of the tool, `allowed()` returns whether they may move now. */
  constructor({ list, tool, speedShare, send, allowed, show }) {
    Object.assign(this, { list, speedShare, send, allowed, show })
    tool.append('tool', ...AXES.flatMap((name, axis) => [
      this.#makeButton({ axis, direction: -1 }, `tool ${name}`, '−'), makeElement('span', name), this.#makeButton({ axis, direction: 1 }, `tool ${name}`, '+'),
    ]))
    setInterval(() => this.#sendWanted(), PERIOD_MS)
  }

  /** Show these joints of the body's description. */
  setJoints(joints) {
    if (JSON.stringify(joints) === JSON.stringify(this.#joints)) return
    this.releaseAll()
    this.#joints = joints
    this.#rows = new Map(joints.map((joint) => [joint.name, this.#makeRow(joint)]))
    this.list.replaceChildren(...[...this.#rows.values()].map(({ row }) => row))
  }

  /** Show the newest state; null if there is none. */
  setState(state) {
    this.list.classList.toggle('off', !this.allowed())
    this.#joints.forEach((joint, i) => this.#fill(joint, state?.joints.find(({ name }) => name === joint.name), state?.joints_sent[i]))
    if (!this.#sent.length) this.show(activity(state))
  }

  /** Count all buttons as released. */
  releaseAll() {
    this.#held.clear()
    this.#sendWanted()
  }

  #sendWanted() {
    const held = this.allowed() ? [...this.#held.values()] : []
    if (!held.length && !this.#sent.length) return
    const all = [...this.#sent, ...held], speeds = {}, tool = all.some(({ axis }) => axis != null) ? [0, 0, 0] : undefined
    for (const { joint } of all) if (joint) speeds[joint.name] = 0
    for (const { joint, axis, direction } of held) {
      if (joint) speeds[joint.name] += direction * this.speedShare() * joint.max_speed
      else tool[axis] += direction * this.speedShare() * MAX_TOOL_SPEED
    }
    this.#sent = held
    this.send(speeds, tool)
    this.show(held.map(({ joint, axis }) => (
      joint ? `${joint.name} ${inUnit(joint, speeds[joint.name], '/s')}` : `tool ${AXES[axis]} ${(100 * tool[axis]).toFixed(0)} cm/s`
    )).join(' · ') || 'released')
  }

  #makeRow(joint) {
    const row = makeElement('li', '', 'joint'), range = makeElement('i', '', 'range'), setpointMark = makeElement('s'), positionMark = makeElement('b')
    const number = makeElement('output', '–'), more = makeElement('small')
    range.setAttribute('role', 'meter')
    range.setAttribute('aria-label', joint.name)
    range.setAttribute('aria-valuemin', joint.lower)
    range.setAttribute('aria-valuemax', joint.upper)
    range.title = `${inUnit(joint, joint.lower)} to ${inUnit(joint, joint.upper)}`
    range.append(setpointMark, positionMark)
    const button = (direction, text) => this.#makeButton({ joint, direction }, joint.name, text)
    row.append(button(-1, '−'), makeElement('span', joint.name), number, range, more, button(1, '+'))
    return { row, range, setpointMark, positionMark, number, more }
  }

  #makeButton(moves, name, text) {
    const button = makeElement('button', text, 'jog')
    button.setAttribute('aria-label', `${name} ${moves.direction > 0 ? 'up' : 'down'}: hold to move it`)
    const hold = () => { this.#held.set(button, moves); this.#sendWanted() }
    const release = () => { if (this.#held.delete(button)) this.#sendWanted() }
    button.addEventListener('pointerdown', (event) => {
      if (event.button > 0) return
      button.setPointerCapture(event.pointerId)
      hold()
    })
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture', 'blur']) button.addEventListener(end, release)
    button.addEventListener('contextmenu', (event) => event.preventDefault()) // of a long press
    button.addEventListener('keydown', (event) => { if (event.key === 'Enter' && !event.repeat) hold() })
    button.addEventListener('keyup', (event) => { if (event.key === 'Enter') release() })
    return button
  }

  #fill(joint, measured, setpoint) {
    const { range, setpointMark, positionMark, number, more } = this.#rows.get(joint.name)
    const share = (position) => `${100 * Math.min(1, Math.max(0, (position - joint.lower) / (joint.upper - joint.lower)))}%`
    positionMark.hidden = !measured
    setpointMark.hidden = !measured || setpoint == null
    if (setpoint != null) setpointMark.style.left = share(setpoint)
    setText(number, measured ? inUnit(joint, measured.position) : '–')
    if (!measured) return range.removeAttribute('aria-valuenow')
    positionMark.style.left = share(measured.position)
    range.setAttribute('aria-valuenow', measured.position)
    range.setAttribute('aria-valuetext', number.textContent)
    const { effort, temperature, current } = measured, force = joint.unit === 'm' ? 'N' : 'N m'
    const known = [[effort, 2, force], [current, 2, 'A'], [temperature, 0, '°C']].filter(([value]) => value != null)
    setText(more, known.map(([value, digits, unit]) => `${value.toFixed(digits).replace(/^-(0\.?0*)$/, '$1')} ${unit}`).join(' · '))
  }
}
