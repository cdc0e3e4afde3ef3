// The WebSocket. Frames are a byte for their kind, then their content. Nothing is queued while it is down.
const ABOUT = 1, MOMENT = 2, SCAN = 3, MAP = 4, HEALTH = 5, LOG = 6, REPLY = 7, IMAGE = 8, TASK = 9
const LOGIN = 1, DRIVE = 2, ASK = 3
const SILENT_MS = 1000, AGAIN_MS = [300, 600, 1200, 2500]
const STRANGER = 4401, FULL = 4429

const text = new TextDecoder(), bytes = new TextEncoder()

export class Link {
  #socket = null
  #tries = 0
  #ids = 0
  #waiting = new Map()
  #received = 0

  /** `on` has about, moment, scan, map, task, health, log, image, state(word) and login(). */
  constructor(on, token) {
    this.on = on
    this.token = token
    this.open()
    setInterval(() => this.#watch(), 250)
  }

  open() {
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws'
    const socket = new WebSocket(`${scheme}://${location.host}/ws`)
    socket.binaryType = 'arraybuffer'
    socket.onopen = () => socket.send(this.#frame(LOGIN, { token: this.token }))
    socket.onmessage = (event) => this.#take(event.data)
    socket.onclose = (event) => this.#closed(event.code)
    this.#socket = socket
  }

  get live() { return performance.now() - this.#received < SILENT_MS }

  drive(x, y, z) {
    if (this.#socket.readyState !== WebSocket.OPEN) return
    const frame = new DataView(new ArrayBuffer(16))
    frame.setUint8(0, DRIVE);
    [x, y, z].forEach((value, i) => frame.setFloat32(4 + 4 * i, value, true))
    this.#socket.send(frame.buffer)
  }

  /** Resolves to the robot's reply, or to the reason why there is none; never rejects. */
  ask(what, more = {}, within = 3000) {
    if (this.#socket.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ ok: false, text: 'this page has no connection' })
    }
    const id = ++this.#ids
    this.#socket.send(this.#frame(ASK, { id, what, ...more }))
    return new Promise((resolve) => {
      const end = (reply) => { this.#waiting.delete(id); clearTimeout(timer); resolve(reply) }
      const timer = setTimeout(() => end({ ok: false, text: 'no answer' }), within)
      this.#waiting.set(id, end)
    })
  }

  #frame(kind, content) {
    const json = bytes.encode(JSON.stringify(content))
    const frame = new Uint8Array(json.length + 1)
    frame[0] = kind
    frame.set(json, 1)
    return frame
  }

  #take(data) {
    const kind = new Uint8Array(data, 0, 1)[0]
    const json = () => JSON.parse(text.decode(new Uint8Array(data, 1)))
    if (kind === MOMENT) { this.#received = performance.now(); this.#tries = 0; this.on.state('live'); this.on.moment(json()) }
    else if (kind === SCAN) this.on.scan(new Float32Array(data, 4, 9), new Float32Array(data, 40))
    else if (kind === MAP) this.on.map(new DataView(data, 4, 20), new Int8Array(data, 24))
    else if (kind === TASK) this.on.task(json())
    else if (kind === HEALTH) this.on.health(json())
    else if (kind === LOG) this.on.log(json())
    else if (kind === REPLY) this.#answer(json())
    else if (kind === IMAGE) this.on.image(data)
    else if (kind === ABOUT) this.on.about(json())
  }

  #answer(reply) {
    const end = this.#waiting.get(reply.id)
    if (end) end(reply)
    else this.on.told(reply)
  }

  #closed(code) {
    for (const end of [...this.#waiting.values()]) end({ ok: false, text: 'the connection was lost' })
    this.#received = 0
    this.on.state('offline')
    if (code === STRANGER) return this.on.login()
    const wait = code === FULL ? 5000 : AGAIN_MS[Math.min(this.#tries++, AGAIN_MS.length - 1)]
    setTimeout(() => this.open(), wait)
  }

  #watch() {
    if (this.#received && !this.live) this.on.state('silent')
  }
}
