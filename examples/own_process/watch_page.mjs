// A program of one's own in JavaScript, through the WebSocket of the operator page.
//
//   node watch_page.mjs http://127.0.0.1:8080 [TOKEN]     (Node 22; Node 20 needs --experimental-websocket)
//
// It prints where the robot is, and presses the e-stop where something comes nearer than 0.15 m.
// A frame is one byte for its kind, then JSON or arrays in little-endian.

const [page, token = ''] = process.argv.slice(2)
const STATE = 2, SCAN = 3, REPLY = 7 // from the page
const LOGIN = 1, ASK = 3 // to the page

// the page takes only its own origin; in a browser its own scripts have it, and leave this out
const socket = new WebSocket(`${page.replace(/^http/, 'ws')}/ws`, { headers: { origin: page } })
socket.binaryType = 'arraybuffer'
let scans = 0, states = 0

function send(kind, content) {
  const json = new TextEncoder().encode(JSON.stringify(content))
  const frame = new Uint8Array(json.length + 1)
  frame[0] = kind
  frame.set(json, 1)
  socket.send(frame)
}

socket.onopen = () => send(LOGIN, { token })
socket.onerror = () => { console.error(`no page at ${page}`); process.exit(1) }
socket.onmessage = ({ data }) => {
  const kind = new Uint8Array(data, 0, 1)[0]
  const json = () => JSON.parse(new TextDecoder().decode(new Uint8Array(data, 1)))
  if (kind === STATE) {
    const { state, pose } = json()
    if (state && pose && states++ % 10 === 0) console.log(`tick ${state.tick}: x ${pose.x.toFixed(2)} m, y ${pose.y.toFixed(2)} m`)
  } else if (kind === SCAN) {
    const ranges = new Float32Array(data, 40) // after 4 bytes, and nine numbers: see `frames.py`
    const nearest = ranges.filter(Number.isFinite).reduce((a, b) => Math.min(a, b), Infinity)
    if (scans++ % 10 === 0) console.log(`${ranges.length} beams, the nearest ${nearest.toFixed(2)} m`)
    if (nearest < 0.15) send(ASK, { id: 1, what: 'estop' }) // the token has to be an operator's
    if (scans > 20) socket.close()
  } else if (kind === REPLY) console.log(json().text)
}
socket.onclose = ({ code }) => process.exit(scans > 20 ? 0 : code)
