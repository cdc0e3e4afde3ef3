// The WebSocket. A frame is a byte for its kind, then its content. Nothing is queued while it is down.
const ABOUT = 1, STATE = 2, SCAN = 3, MAP = 4, HEALTH = 5, LOG = 6, REPLY = 7, IMAGE = 8, TASK = 9, SCENE = 10, POSES = 11, ZONES = 12
const CAMERA = 13, FOUND = 14, CONTOURS = 15, PERCEIVED = 16, OBJECTS = 17, ARM_PLAN = 18
const LOGIN = 1, DRIVE = 2, ASK = 3, WATCH = 4, SHOWN = 5, JOG = 6
const SILENT_AFTER_MS = 1000, RETRY_MS = [300, 600, 1200, 2500], FULL_RETRY_MS = 5000
const CHECK_MS = 250, MAX_SILENT_CHECKS = 80 // 20 s; checks are counted, as a suspended page receives nothing
// longer than the server waits for the robot, so that the page still gets its answer
const ANSWER_TIMEOUT_MS = 3000, ANSWER_TIMEOUTS_MS = { estop: 2500, world: 5000, zones: 8000, maps: 25_000, map_save: 25_000, map_load: 25_000 }
const WRONG_TOKEN = 4401, FULL = 4429 // codes of a closed WebSocket

const decoder = new TextDecoder(), encoder = new TextEncoder()

export class Link {
  #socket = null
  #failures = 0 // connections in a row that failed
  #lastId = 0
  #pending = new Map() // by the id of a request: the function that resolves it
  #receivedMs = 0
  #silentChecks = 0

  /** `on` has the handlers about, robot, scan, map, task, health, log, image, camera, found, contours, perceived, objects, armPlan, scene, poses, zones, reply, connection(status) and login(). */
  constructor(on, token) {
    this.on = on
    this.token = token
    this.open()
    setInterval(() => this.#checkSilence(), CHECK_MS)
  }

  open() {
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws'
    const socket = new WebSocket(`${scheme}://${location.host}/ws`)
    socket.binaryType = 'arraybuffer'
    socket.onopen = () => socket.send(this.#frame(LOGIN, { token: this.token }))
    socket.onmessage = (event) => this.#receive(event.data)
    socket.onclose = (event) => this.#closed(event.code)
    this.#socket = socket
    this.#silentChecks = 0
  }

  get live() { return performance.now() - this.#receivedMs < SILENT_AFTER_MS }

  drive(x, y, z) {
    if (this.#socket.readyState !== WebSocket.OPEN) return
    const frame = new DataView(new ArrayBuffer(16))
    frame.setUint8(0, DRIVE);
    [x, y, z].forEach((value, i) => frame.setFloat32(4 + 4 * i, value, true))
    this.#socket.send(frame.buffer)
  }

  /** Send the speeds of joints, and that of the tool. */
  jog(speeds, tool) { this.#send(JOG, { speeds, tool }) }

  /** Tell the server which pictures are wanted. */
  watch(wanted) { this.#send(WATCH, wanted) }

  /** Tell the server that a camera's picture is shown, so that it may send the next one. */
  shown(camera) { this.#send(SHOWN, { camera }) }

  #send(kind, content) {
    if (this.#socket.readyState === WebSocket.OPEN) this.#socket.send(this.#frame(kind, content))
  }

  /** Resolve to the robot's reply, or to the reason why there is none; never reject. */
  request(what, more = {}) {
    if (this.#socket.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ ok: false, text: 'this page has no connection' })
    }
    const id = ++this.#lastId
    this.#socket.send(this.#frame(ASK, { id, what, ...more }))
    return new Promise((resolve) => {
      const finish = (reply) => { this.#pending.delete(id); clearTimeout(timer); resolve(reply) }
      const timer = setTimeout(() => finish({ ok: false, text: 'no answer' }), ANSWER_TIMEOUTS_MS[what] ?? ANSWER_TIMEOUT_MS)
      this.#pending.set(id, finish)
    })
  }

  #frame(kind, content) {
    const json = encoder.encode(JSON.stringify(content))
    const frame = new Uint8Array(json.length + 1)
    frame[0] = kind
    frame.set(json, 1)
    return frame
  }

  #receive(data) {
    const kind = new Uint8Array(data, 0, 1)[0]
    const json = () => JSON.parse(decoder.decode(new Uint8Array(data, 1)))
    if (kind === STATE) { this.#receivedMs = performance.now(); this.#failures = 0; this.on.connection('live'); this.on.robot(json()) }
    else if (kind === SCAN) this.on.scan(new Float32Array(data, 4, 9), new Float32Array(data, 40))
    else if (kind === MAP) this.on.map(new DataView(data, 4, 20), new Int8Array(data, 24))
    else if (kind === TASK) this.on.task(json())
    else if (kind === ZONES) this.on.zones(json())
    else if (kind === SCENE) this.on.scene(json())
    else if (kind === POSES) this.on.poses(new DataView(data).getUint32(4, true), new Float32Array(data, 8))
    else if (kind === HEALTH) this.on.health(json())
    else if (kind === LOG) this.on.log(json())
    else if (kind === REPLY) this.#resolve(json())
    else if (kind === IMAGE) this.on.image(data)
    else if (kind === FOUND) this.on.found(json())
    else if (kind === CONTOURS) this.on.contours(json())
    else if (kind === PERCEIVED) this.on.perceived(json())
    else if (kind === OBJECTS) this.on.objects(json())
    else if (kind === ARM_PLAN) this.on.armPlan(json())
    else if (kind === CAMERA) this.on.camera(json())
    else if (kind === ABOUT) this.on.about(json())
  }

  #resolve(reply) {
    const finish = this.#pending.get(reply.id)
    if (finish) finish(reply)
    else this.on.reply(reply)
  }

  #closed(code) {
    for (const finish of [...this.#pending.values()]) finish({ ok: false, text: 'the connection was lost' })
    this.#receivedMs = 0
    this.on.connection('offline')
    if (code === WRONG_TOKEN) return this.on.login()
    const waitMs = code === FULL ? FULL_RETRY_MS : RETRY_MS[Math.min(this.#failures++, RETRY_MS.length - 1)]
    setTimeout(() => this.open(), waitMs)
  }

  #checkSilence() {
    if (this.#receivedMs && !this.live) this.on.connection('silent')
    this.#silentChecks = this.live ? 0 : this.#silentChecks + 1
    if (this.#silentChecks > MAX_SILENT_CHECKS && this.#socket.readyState < WebSocket.CLOSING) this.#abandon()
  }

  /** Replace a connection whose end is not reported, for example when the robot loses its power. */
  #abandon() {
    this.#socket.onmessage = this.#socket.onclose = null
    this.#socket.close()
    this.#closed()
  }
}
