// Panels next to the map: gate, safety, processes, topics, log, images. Messages are shown as text, never as HTML.
export const $ = (id) => document.getElementById(id)
const MODES = { enabled: 'driving allowed', idle: 'idle', stopping: 'stopping', latched: 'latched' }
const LINES = 200, LATE_MS = 3000
const AXES = [
  ['forward', 'max_linear_speed', 'm/s'], ['backward', 'max_linear_speed', 'm/s'],
  ['left', 'max_lateral_speed', 'm/s'], ['right', 'max_lateral_speed', 'm/s'],
  ['turn_left', 'max_angular_speed', 'rad/s'], ['turn_right', 'max_angular_speed', 'rad/s'],
]

export function put(element, text) {
  if (element.textContent !== text) element.textContent = text
}

export function make(tag, text = '', kind = '') {
  const element = document.createElement(tag)
  element.textContent = text
  if (kind) element.className = kind
  return element
}

/** Replaces the children only when their text has changed, so that a screen reader reads nothing twice. */
function replace(parent, key, children) {
  if (parent.dataset.key === key) return
  parent.dataset.key = key
  parent.replaceChildren(...children())
}

function listCauses(list, causes) {
  replace(list, JSON.stringify(causes), () => causes.map((cause) => {
    const item = make('li', cause.text, cause.latching ? 'latching' : '')
    if (cause.remedy) item.append(make('small', `→ ${cause.remedy}`))
    return item
  }))
}

export function showGate(state, looking) {
  const gate = state?.gate
  $('gate').dataset.mode = gate?.mode ?? 'silent'
  put($('mode'), gate ? MODES[gate.mode] : 'silent')
  const who = gate?.commander === 'control' ? 'the brain' : gate?.commander
  put($('who'), gate ? `commander: ${who || 'none'}` : '')
  const silent = { text: 'no messages from the robot', remedy: 'check its driver and the network', latching: true }
  listCauses($('causes'), gate ? gate.causes : [silent])
  $('release').disabled = gate?.mode !== 'latched'
  $('enable').disabled = !gate || gate.mode === 'latched' || gate.mode === 'stopping'
  $('take').disabled = gate?.mode !== 'enabled' || gate.commander === 'control'
  $('release').classList.toggle('urge', !$('release').disabled)
  $('enable').classList.toggle('urge', gate?.mode === 'idle')
  document.body.classList.toggle('looking', looking)
}

export function showFigures(state, moment) {
  const v = state?.velocity
  put($('speed'), v ? `${v.linear_x.toFixed(2)} m/s  ${v.angular_z.toFixed(2)} rad/s` : '–')
  put($('battery'), state?.battery ? `${state.battery.percentage.toFixed(0)} %  ${state.battery.voltage.toFixed(1)} V` : '–')
  const heat = (state?.joints ?? []).map((joint) => joint.temperature).filter((t) => t !== null)
  put($('heat'), heat.length ? `${Math.max(...heat).toFixed(0)} °C` : '–')
  put($('doing'), doing(state, moment))
}

function doing(state, moment) {
  if (!state) return 'no messages from the robot'
  const { mode, commander } = state.gate
  if (mode !== 'enabled' && compiling.size) return `starting up: ${[...compiling].join(' and ')} compiling (once per installation)`
  if (mode !== 'enabled') return mode === 'idle' ? 'at rest, waiting to be enabled' : mode
  if (commander !== 'control') return `${commander} drives`
  if (moment.driving) return `steered by viewer ${moment.driving}`
  return moment.intent?.reason ?? 'no messages from decision'
}

export function showSafety(safety, body) {
  put($('verdict'), safety?.verdict ?? 'silent')
  listCauses($('warnings'), [...(safety?.causes ?? []), ...(safety?.warnings ?? []), ...problems()])
  if (!body) return
  const caps = safety?.caps ?? {}
  const rows = AXES.filter(([, most]) => body[most] > 0).map(([name, key, unit]) => {
    const turning = name.startsWith('turn') ? [caps.rotation, caps[name]].filter((c) => c != null) : [caps[name]].filter((c) => c != null)
    return [name.replace('_', ' '), body[key], safety ? Math.min(body[key], ...turning) : 0, unit]
  })
  replace($('caps'), JSON.stringify(rows), () => rows.flatMap(([name, most, allowed, unit]) => {
    const bar = make('i'), fill = make('b', '', allowed < most ? 'capped' : '')
    fill.style.width = `${(100 * allowed) / most}%`
    bar.append(fill)
    return [make('span', name), bar, make('span', `${allowed.toFixed(2)} ${unit}`)]
  }))
}

/** Shows the present task and its progress, or the result of the last one. */
export function showTask(status, looking) {
  const { current } = status
  $('cancel').hidden = looking || !current
  $('goal').className = current || status.done[0]?.state !== 'failed' ? 'note' : 'note bad'
  put($('goal'), current ? present(status) : lastTask(status.done[0]))
}

function present({ current, doing, distance_remaining: left, eta, queue }) {
  const words = [current.state === 'paused' ? `paused: ${doing}` : doing || current.label]
  if (left != null) words.push(`${left.toFixed(1)} m left`)
  if (eta != null) words.push(`about ${since(eta)}`)
  if (current.reason && current.reason !== words[0]) words.push(current.reason)
  if (queue.length) words.push(`then ${queue.map((task) => task.label).join(', ')}`)
  return words.join(' · ')
}

function lastTask(task) {
  return task ? [`${task.label}: ${task.state}`, task.reason].filter(Boolean).join(' · ') : ''
}

const healths = new Map() // process -> [health, when]
const compiling = new Set() // processes that are compiling

export function showHealth(health) {
  healths.set(health.process, [health, performance.now()])
  showTables()
}

function problems() {
  return [...healths.values()].flatMap(([health]) => health.problems ?? [])
}

export function showTables() {
  const now = performance.now()
  const all = [...healths].sort().map(([, heard]) => heard)
  if (!$('processes').hidden) fill($('processes'), all.map(([health, at]) => processRow(health, now - at > LATE_MS)))
  if (!$('topics').hidden) fill($('topics'), topicRows(all.map(([health]) => health)))
  const driver = healths.get('driver')?.[0].latency_ms ?? {}
  const [p50, p99] = [driver.scan_to_cmd_p50, driver.scan_to_cmd_p99]
  put($('latency'), p50 ? `${p50.toFixed(1)} ms (p99 ${p99.toFixed(1)})` : '–')
}

function processRow(health, late) {
  const latency = Object.entries(health.latency_ms).map(([name, ms]) => `${name.replaceAll('_', ' ')} ${ms.toFixed(1)} ms`)
  const refused = Object.values(health.rejected).reduce((sum, n) => sum + n, 0)
  const cells = [
    health.process, late ? 'silent' : `${(100 * health.cpu).toFixed(1)} %`, `${(health.rss_bytes / 1e6).toFixed(0)} MB`,
    since(health.uptime_s), latency.join(', '), String(refused), health.host,
  ]
  return { cells, numbers: [1, 2, 3, 5], late }
}

function topicRows(all) {
  const topics = new Map()
  for (const health of all) {
    for (const [key, hz] of Object.entries(health.sent_hz)) {
      const topic = topics.get(key) ?? { hz: 0, from: [], to: [] }
      topic.hz += hz
      topic.from.push(health.process)
      topics.set(key, topic)
    }
  }
  for (const health of all) {
    for (const key of Object.keys(health.received_hz)) topics.get(key)?.to.push(health.process)
  }
  return [...topics].filter(([key]) => !key.startsWith('robot/health/')).sort().map(([key, topic]) => (
    { cells: [key, `${topic.hz.toFixed(1)} Hz`, topic.from.join(', '), topic.to.join(', ')], numbers: [1] }
  ))
}

function fill(panel, rows) {
  panel.querySelector('tbody').replaceChildren(...rows.map(({ cells, numbers, late }) => {
    const row = make('tr', '', late ? 'late' : '')
    row.append(...cells.map((text, i) => make('td', text, numbers.includes(i) ? 'n' : '')))
    return row
  }))
}

function since(seconds) {
  if (seconds < 90) return `${seconds.toFixed(0)} s`
  return seconds < 5400 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(1)} h`
}

export function showLogLine(line) {
  if (line.event === 'compiling') compiling.add(line.process)
  if (line.event === 'ready') compiling.delete(line.process)
  const list = $('log').firstElementChild, item = make('li', '', line.level)
  item.append(make('time', new Date(line.stamp_ns / 1e6).toLocaleTimeString()), make('span', line.process, 'p'), make('span', line.text))
  list.prepend(item)
  while (list.children.length > LINES) list.lastElementChild.remove()
}

export function showImage(data) {
  const head = new DataView(data, 4, 88), text = new TextDecoder()
  const [width, height] = [head.getUint32(0, true), head.getUint32(4, true)]
  const word = (at, length) => text.decode(new Uint8Array(data, 4 + at, length)).replace(/\0+$/, '')
  const camera = word(8, 64), encoding = word(72, 16), pixels = new Uint8Array(data, 92)
  const canvas = pictureOf(camera), pen = canvas.getContext('2d')
  if (encoding === 'jpeg') {
    createImageBitmap(new Blob([pixels], { type: 'image/jpeg' })).then((picture) => {
      canvas.width = picture.width
      canvas.height = picture.height
      pen.drawImage(picture, 0, 0)
    }, () => {})
    return
  }
  const step = { rgb8: 3, bgr8: 3, mono8: 1 }[encoding]
  if (!step) return
  const image = new ImageData(width, height), order = { rgb8: [0, 1, 2], bgr8: [2, 1, 0], mono8: [0, 0, 0] }[encoding]
  for (let i = 0; i < width * height; i++) {
    order.forEach((from, to) => { image.data[4 * i + to] = pixels[step * i + from] })
    image.data[4 * i + 3] = 255
  }
  canvas.width = width
  canvas.height = height
  pen.putImageData(image, 0, 0)
}

function pictureOf(camera) {
  const known = [...$('pictures').children].find((figure) => figure.dataset.camera === camera)
  if (known) return known.querySelector('canvas')
  const figure = make('figure')
  figure.dataset.camera = camera
  figure.append(make('canvas'), make('figcaption', camera))
  $('pictures').append(figure)
  return figure.querySelector('canvas')
}
