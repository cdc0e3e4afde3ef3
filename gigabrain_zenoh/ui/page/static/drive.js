// Joystick, keys and gamepad. Sends commands only while one of them is held, and one zero at the end.
const PERIOD_MS = 40
const KEYS = {
  KeyW: [1, 0, 0], ArrowUp: [1, 0, 0], KeyS: [-1, 0, 0], ArrowDown: [-1, 0, 0],
  KeyA: [0, 0, 1], ArrowLeft: [0, 0, 1], KeyD: [0, 0, -1], ArrowRight: [0, 0, -1],
  KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
}
const SHOULDER_BUTTONS = [4, 5], STOP_BUTTON = 1, DEAD_ZONE = 0.12
const gamepads = () => (document.hidden ? [] : [...(navigator.getGamepads?.() ?? [])].filter(Boolean))
const isTextInput = (target) => target.matches?.('input:not([type=range]), textarea')

export class Drive {
  #held = new Set()
  #stick = null // [x, z] while it is held
  #sending = false
  #padIgnored = false // until its shoulder buttons are released
  #stopsPressed = 0 // number of held stop buttons of all gamepads

  /** `limits()` returns the highest speeds, `send(x, y, z)` sends a velocity, `stop()` is the e-stop. */
  constructor({ stick, speedShare, limits, send, stop, allowed, show }) {
    Object.assign(this, { stick, speedShare, limits, send, stop, allowed, show })
    this.#listenToKeys()
    this.#listenToStick()
    setInterval(() => { this.#readStopButtons(); this.#sendWanted() }, PERIOD_MS)
  }

  /** Count all keys, the joystick and gamepads as released. */
  releaseAll() {
    this.#held.clear()
    this.#padIgnored = true
    this.#centreStick()
    this.#sendWanted()
  }

  #sendWanted() {
    const [x, y, z] = this.#axes()
    const held = this.allowed() && (x || y || z)
    if (!held && !this.#sending) return
    const limits = this.limits(), share = held ? this.speedShare() : 0
    const wanted = [x * share * limits.x, y * share * limits.y, z * share * limits.z]
    this.#sending = Boolean(held)
    this.send(...wanted)
    this.show(held ? wanted : null)
  }

  #axes() {
    if (this.#stick) return [this.#stick[0], 0, this.#stick[1]]
    const sum = [0, 0, 0]
    for (const code of this.#held) KEYS[code].forEach((value, i) => { sum[i] += value })
    return sum.some(Boolean) ? sum.map(Math.sign) : this.#gamepadAxes()
  }

  /** Stop once for each press of a gamepad's stop button, also while keys or the joystick are held. */
  #readStopButtons() {
    const pressed = gamepads().filter(({ buttons }) => buttons[STOP_BUTTON]?.pressed).length
    if (pressed > this.#stopsPressed) this.stop()
    this.#stopsPressed = pressed
  }

  #gamepadAxes() {
    const [pad] = gamepads()
    const held = pad && SHOULDER_BUTTONS.some((n) => pad.buttons[n]?.pressed)
    this.#padIgnored = held && (this.#padIgnored || !document.hasFocus()) // another window may show another robot
    if (!held || this.#padIgnored) return [0, 0, 0]
    const axis = (n) => (Math.abs(pad.axes[n] ?? 0) < DEAD_ZONE ? 0 : -pad.axes[n])
    return [axis(1), axis(0), axis(2)]
  }

  #listenToKeys() {
    addEventListener('keydown', (event) => {
      if (event.code === 'Space' && !isTextInput(event.target)) {
        event.preventDefault()
        if (!event.repeat) { this.releaseAll(); this.stop() }
      } else if (event.code in KEYS && !isTextInput(event.target) && !event.ctrlKey && !event.metaKey && !event.altKey) {
        if (event.target.matches?.('[role=tab], [type=range]') && event.code.startsWith('Arrow')) return
        event.preventDefault()
        if (!event.repeat) { this.#held.add(event.code); this.#sendWanted() }
      }
    }, true)
    // the space bar that stops must not press the button that has the focus
    addEventListener('keyup', (event) => {
      if (event.code === 'Space' && !isTextInput(event.target)) event.preventDefault()
      if (this.#held.delete(event.code)) this.#sendWanted()
    }, true)
  }

  #listenToStick() {
    const move = (event) => {
      const box = this.stick.getBoundingClientRect(), radius = box.width / 2
      const right = (event.clientX - box.left) / radius - 1, down = (event.clientY - box.top) / radius - 1
      const length = Math.max(1, Math.hypot(right, down))
      this.#stick = [-down / length, -right / length].map((v) => (Math.abs(v) < DEAD_ZONE ? 0 : v))
      const knob = this.stick.firstElementChild
      knob.style.transform = `translate(${(right / length) * radius * 0.7}px, ${(down / length) * radius * 0.7}px)`
    }
    this.stick.addEventListener('contextmenu', (event) => event.preventDefault()) // the menu would hide the release
    this.stick.addEventListener('pointerdown', (event) => {
      if (event.button > 0) return
      this.stick.setPointerCapture(event.pointerId)
      move(event)
      this.#sendWanted()
    })
    this.stick.addEventListener('pointermove', (event) => this.#stick && move(event))
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      this.stick.addEventListener(end, () => { this.#centreStick(); this.#sendWanted() })
    }
  }

  #centreStick() {
    this.#stick = null
    this.stick.firstElementChild.style.transform = ''
  }
}
