// Panels beside the map: gate, safety, processes, topics, log. Messages are shown as text, never as HTML.
export const $ = (id) => document.getElementById(id)
const MODES = { enabled: 'driving allowed', idle: 'idle', stopping: 'stopping', latched: 'latched' }
const IMAGE = 'robot/image/'
const MAX_LOG_LINES = 200, SILENT_AFTER_MS = 3000
const AXES = [
  ['forward', 'max_linear_speed', 'm/s'], ['backward', 'max_linear_speed', 'm/s'],
  ['left', 'max_lateral_speed', 'm/s'], ['right', 'max_lateral_speed', 'm/s'],
  ['turn_left', 'max_angular_speed', 'rad/s'], ['turn_right', 'max_angular_speed', 'rad/s'],
]

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text
}

export function makeElement(tag, text = '', kind = '') {
  const element = document.createElement(tag)
  element.textContent = text
  if (kind) element.className = kind
  return element
}

/** Replace the children only when `key` has changed, so that a screen reader reads nothing twice. */
function replaceChildren(parent, key, children) {
  if (parent.dataset.key === key) return
  parent.dataset.key = key
  parent.replaceChildren(...children())
}

function listCauses(list, causes) {
  replaceChildren(list, JSON.stringify(causes), () => causes.map((cause) => {
    const item = makeElement('li', cause.text, cause.latching ? 'latching' : '')
    if (cause.remedy) item.append(makeElement('small', `→ ${cause.remedy}`))
    return item
  }))
}

export function showGate(state, viewOnly) {
  const gate = state?.gate
  $('gate').dataset.mode = gate?.mode ?? 'silent'
  setText($('mode'), gate ? MODES[gate.mode] : 'silent')
  const commander = gate?.commander === 'control' ? 'the brain' : gate?.commander
  setText($('commander'), gate ? `commander: ${commander || 'none'}` : '')
  const silent = { text: 'no messages from the robot', remedy: 'check its driver and the network', latching: true }
  listCauses($('causes'), gate ? gate.causes : [silent])
  $('release').disabled = gate?.mode !== 'latched'
  $('enable').disabled = !gate || gate.mode === 'latched' || gate.mode === 'stopping'
  $('take').disabled = gate?.mode !== 'enabled' || gate.commander === 'control'
  $('release').classList.toggle('urge', !$('release').disabled)
  $('enable').classList.toggle('urge', gate?.mode === 'idle')
  document.body.classList.toggle('view-only', viewOnly)
}

export function showFigures(state, robot) {
  const v = state?.velocity
  setText($('speed'), v ? `${v.linear_x.toFixed(2)} m/s · ${v.angular_z.toFixed(2)} rad/s` : '–')
  setText($('battery'), state?.battery ? `${state.battery.percentage.toFixed(0)} % · ${state.battery.voltage.toFixed(1)} V` : '–')
  const temperatures = (state?.joints ?? []).map((joint) => joint.temperature).filter((t) => t !== null)
  setText($('temperature'), temperatures.length ? `${Math.max(...temperatures).toFixed(0)} °C` : '–')
  setText($('doing'), activity(state, robot))
}

/** Describe what the robot does. */
function activity(state, robot) {
  if (!state) return 'no messages from the robot'
  const { mode, commander } = state.gate
  if (state.limp) return 'limp: the motors of its joints are off'
  if (mode !== 'enabled' && compiling.size) return `compiling, once per installation: ${[...compiling].join(', ')}`
  if (mode !== 'enabled') return mode === 'idle' ? 'idle: waiting to be enabled' : MODES[mode]
  if (commander !== 'control') return `${commander} drives`
  if (robot.driving) return `steered by viewer ${robot.driving}`
  return robot.intent?.reason ?? 'no messages from decision'
}

export function showSafety(safety, body) {
  setText($('verdict'), safety?.verdict ?? 'silent')
  listCauses($('warnings'), [...(safety?.causes ?? []), ...(safety?.warnings ?? []), ...problemsOfProcesses()])
  if (!body) return
  const caps = safety?.caps ?? {}, stopped = !safety || safety.verdict === 'stop'
  const rows = AXES.filter(([, limit]) => body[limit] > 0).map(([name, limit, unit]) => {
    const lower = [caps[name], name.startsWith('turn') ? caps.rotation : null].filter((cap) => cap != null)
    return [name.replace('_', ' '), body[limit], stopped ? 0 : Math.min(body[limit], ...lower), unit]
  })
  replaceChildren($('caps'), JSON.stringify(rows), () => rows.flatMap(([name, limit, allowed, unit]) => {
    const bar = makeElement('i'), fill = makeElement('b', '', allowed < limit ? 'capped' : '')
    fill.style.width = `${(100 * allowed) / limit}%`
    bar.append(fill)
    return [makeElement('span', name), bar, makeElement('span', `${allowed.toFixed(2)} ${unit}`)]
  }))
}

/** Show the present task and its progress, or the result of the last one. */
export function showTask(status, viewOnly) {
  const { current } = status
  $('cancel').hidden = viewOnly || !current
  $('goal').className = current || status.done[0]?.state !== 'failed' ? 'note' : 'note bad'
  setText($('goal'), current ? presentTask(status) : lastTask(status.done[0]))
}

function presentTask({ current, doing, distance_remaining: left, eta, queue }) {
  const words = [current.state === 'paused' ? `paused: ${doing}` : doing || current.label]
  if (left != null) words.push(`${left.toFixed(1)} m left`)
  if (eta != null) words.push(`about ${duration(eta)}`)
  if (current.reason && current.reason !== words[0]) words.push(current.reason)
  if (queue.length) words.push(`then ${queue.map((task) => task.label).join(', ')}`)
  return words.join(' · ')
}

function lastTask(task) {
  return task ? [`${task.label}: ${task.state}`, task.reason].filter(Boolean).join(' · ') : ''
}

const healthByProcess = new Map() // [newest health, its arrival in ms]
const compiling = new Set() // names of processes

export function showHealth(health) {
  healthByProcess.set(health.process, [health, performance.now()])
  showTables()
}

function problemsOfProcesses() {
  return [...healthByProcess.values()].flatMap(([health]) => health.problems ?? [])
}

/** Return the cameras whose pictures are published, according to the health of processes. */
export function publishedCameras() {
  const keys = [...healthByProcess.values()].flatMap(([health]) => Object.keys(health.sent_hz))
  return keys.filter((key) => key.startsWith(IMAGE)).map((key) => key.slice(IMAGE.length))
}

export function showTables() {
  const now = performance.now()
  const all = [...healthByProcess].sort().map(([, entry]) => entry)
  if (!$('processes').hidden) fillTable($('processes'), all.map(([health, arrivalMs]) => processRow(health, now - arrivalMs > SILENT_AFTER_MS)))
  if (!$('topics').hidden) fillTable($('topics'), topicRows(all.map(([health]) => health)))
  const driver = healthByProcess.get('driver')?.[0].latency_ms ?? {}
  const [p50, p99] = [driver.scan_to_cmd_p50, driver.scan_to_cmd_p99]
  setText($('latency'), p50 ? `${p50.toFixed(1)} ms (p99 ${p99.toFixed(1)})` : '–')
}

function processRow(health, silent) {
  const latency = Object.entries(health.latency_ms).map(([name, ms]) => `${name.replaceAll('_', ' ')} ${ms.toFixed(1)} ms`)
  const rejected = Object.values(health.rejected).reduce((sum, n) => sum + n, 0)
  const cells = [
    health.process, silent ? 'silent' : `${(100 * health.cpu).toFixed(1)} %`, `${(health.rss_bytes / 1e6).toFixed(0)} MB`,
    duration(health.uptime_s), latency.join(', '), String(rejected), health.host,
  ]
  return { cells, numbers: [1, 2, 3, 5], silent }
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

export function fillTable(panel, rows) {
  panel.querySelector('tbody').replaceChildren(...rows.map(({ cells, numbers, silent }) => {
    const row = makeElement('tr', '', silent ? 'silent' : '')
    row.append(...cells.map((text, i) => makeElement('td', text, numbers.includes(i) ? 'n' : '')))
    return row
  }))
}

function duration(seconds) {
  if (seconds < 90) return `${seconds.toFixed(0)} s`
  return seconds < 5400 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(1)} h`
}

export function showLogLine(line) {
  if (line.event === 'compiling') compiling.add(line.process)
  if (line.event === 'ready') compiling.delete(line.process)
  const list = $('log').firstElementChild, item = makeElement('li', '', line.level)
  item.append(makeElement('time', new Date(line.stamp_ns / 1e6).toLocaleTimeString([], { hour12: false })), makeElement('span', line.process, 'p'), makeElement('span', line.text))
  list.prepend(item)
  while (list.children.length > MAX_LOG_LINES) list.lastElementChild.remove()
}
