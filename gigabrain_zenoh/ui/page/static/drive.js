// Joystick, keys and gamepad. Sends commands only while something is held, and one zero at the end.
const PERIOD_MS = 40
const KEYS = {
  KeyW: [1, 0, 0], ArrowUp: [1, 0, 0], KeyS: [-1, 0, 0], ArrowDown: [-1, 0, 0],
  KeyA: [0, 0, 1], ArrowLeft: [0, 0, 1], KeyD: [0, 0, -1], ArrowRight: [0, 0, -1],
  KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
}
const SHOULDERS = [4, 5], PAD_STOP = 1, DEAD_ZONE = 0.12
const typing = (target) => target.matches?.('input:not([type=range]), textarea')

export class Drive {
  #held = new Set()
  #stick = null // [x, z] while it is held
  #sending = false
  #padStopped = false

  /** `limits()` returns the greatest speeds, `send(x, y, z)` sends a velocity, `stop()` is the e-stop. */
  constructor({ stick, share, limits, send, stop, allowed, show }) {
    Object.assign(this, { stick, share, limits, send, stop, allowed, show })
    this.#listenToKeys()
    this.#listenToStick()
    setInterval(() => this.#tick(), PERIOD_MS)
  }

  letGo() {
    this.#held.clear()
    this.#centre()
    this.#tick()
  }

  #tick() {
    const [x, y, z] = this.#axes()
    const held = this.allowed() && (x || y || z)
    if (!held && !this.#sending) return
    const most = this.limits(), share = held ? this.share() : 0
    const wanted = [x * share * most.x, y * share * most.y, z * share * most.z]
    this.#sending = Boolean(held)
    this.send(...wanted)
    this.show(held ? wanted : null)
  }

  #axes() {
    if (this.#stick) return [this.#stick[0], 0, this.#stick[1]]
    const sum = [0, 0, 0]
    for (const code of this.#held) KEYS[code].forEach((value, i) => { sum[i] += value })
    return sum.some(Boolean) ? sum.map(Math.sign) : this.#pad()
  }

  #pad() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find(Boolean)
    if (!pad || document.hidden) return [0, 0, 0]
    const pressed = pad.buttons[PAD_STOP]?.pressed ?? false
    const before = this.#padStopped
    this.#padStopped = pressed // first: to stop is to let go, which looks at the pad again
    if (pressed && !before) this.stop()
    if (!SHOULDERS.some((n) => pad.buttons[n]?.pressed)) return [0, 0, 0]
    const axis = (n) => (Math.abs(pad.axes[n] ?? 0) < DEAD_ZONE ? 0 : -pad.axes[n])
    return [axis(1), axis(0), axis(2)]
  }

  #listenToKeys() {
    addEventListener('keydown', (event) => {
      if (event.code === 'Space' && !typing(event.target)) {
        event.preventDefault()
        if (!event.repeat) { this.letGo(); this.stop() }
      } else if (event.code in KEYS && !typing(event.target) && !event.ctrlKey && !event.metaKey && !event.altKey) {
        if (event.target.matches?.('[role=tab], [type=range]') && event.code.startsWith('Arrow')) return
        event.preventDefault()
        if (!event.repeat) { this.#held.add(event.code); this.#tick() }
      }
    }, true)
    // a button that has the focus must not be pressed by the space bar that stops
    addEventListener('keyup', (event) => {
      if (event.code === 'Space' && !typing(event.target)) event.preventDefault()
      if (this.#held.delete(event.code)) this.#tick()
    }, true)
    addEventListener('blur', () => this.letGo())
    document.addEventListener('visibilitychange', () => this.letGo())
  }

  #listenToStick() {
    const move = (event) => {
      const box = this.stick.getBoundingClientRect(), radius = box.width / 2
      const right = (event.clientX - box.left) / radius - 1, down = (event.clientY - box.top) / radius - 1
      const length = Math.max(1, Math.hypot(right, down))
      this.#stick = [-down / length, -right / length].map((v) => (Math.abs(v) < DEAD_ZONE ? 0 : v))
      const knob = this.stick.firstElementChild
      knob.style.transform = `translate(${(right / length) * radius * 0.7}px, ${(down / length) * radius * 0.7}px)`
      this.#tick()
    }
    this.stick.addEventListener('pointerdown', (event) => {
      this.stick.setPointerCapture(event.pointerId)
      move(event)
    })
    this.stick.addEventListener('pointermove', (event) => this.#stick && move(event))
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      this.stick.addEventListener(end, () => { this.#centre(); this.#tick() })
    }
  }

  #centre() {
    this.#stick = null
    this.stick.firstElementChild.style.transform = ''
  }
}
