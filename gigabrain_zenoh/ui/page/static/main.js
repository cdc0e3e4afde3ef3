// Connects the parts of the page: shows the frames that the link receives, and sends the operator's requests.
import { Arm, ArmHold, toolText } from './arm.js'
import { Cameras } from './cameras.js'
import { Drive } from './drive.js'
import { Link } from './link.js'
import { MapView } from './map.js'
import { Objects } from './objects.js'
import { $, publishedCameras, setText, showFigures, showGate, showHealth, showLogLine, showSafety, showTables, showTask } from './panels.js'
import { onLostRelease } from './release.js'
import { Settings } from './settings.js'
import { WorldView } from './world_view.js'
import { Zones } from './zones.js'

const ARM_DISTANCE_M = 0.9 // from the camera to an arm
const NARROW_PX = 860 // narrower pages have the layout of a phone; see style.css
const STOP_BY_HAND = 'press the hardware e-stop or cut the power'
const stored = (key) => { try { return sessionStorage.getItem(key) ?? '' } catch { return '' } }
const decoded = (text) => { try { return decodeURIComponent(text) } catch { return text } } // a % that begins no URL escape
const store = (key, value) => { try { sessionStorage.setItem(key, value) } catch { /* private mode */ } }

let about = { role: 'operator', body: null }
let robot = null // its present state
let connectionLost = false // the next connection may be to another run of the robot

const token = decoded(location.hash.slice(1))
if (token) { store('token', token); history.replaceState(null, '', location.pathname) }
addEventListener('hashchange', () => location.reload()) // another token

const map = new MapView($('map'), sendGoal)
const world = new WorldView($('world'), {
  change: (request) => link.request('world', { world: request }),
  say: (text, ok) => show($('goal'), text, `note${ok ? '' : ' bad'}`),
})
const zones = new Zones(map, {
  request: (what, more) => link.request(what, more),
  say: (text, ok) => show($('zone-note'), text, `note${ok ? '' : ' bad'}`),
})
const objects = new Objects(map, { go: requestGoal, allowed: () => !viewOnly() })
const cameras = new Cameras({ watch: (wanted) => link.watch(wanted), shown: (camera) => link.shown(camera) })
const link = new Link({
  about(info) {
    const first = !about.body
    about = info
    if (connectionLost) forget()
    connectionLost = false
    map.body = info.body
    setText($('robot'), info.body ? `${info.body.robot_type} · ${info.link}` : 'gigabrain')
    document.title = `${info.body?.robot_type ?? 'gigabrain'}${viewOnly() ? ' (view only)' : ''}`
    cameras.add((info.body?.cameras ?? []).map(({ name }) => name))
    if (first && info.body?.cameras.length && innerWidth > NARROW_PX) cameras.open(true)
    else cameras.resume()
    showDrives(info.body)
    $('estop').disabled = viewOnly()
    $('edit-zones').hidden = viewOnly()
    $('estop').querySelector('small').textContent = viewOnly() ? 'view only: this token cannot stop the robot' : 'space bar'
  },
  robot(now) {
    robot = now
    if (now.state?.gate.mode === 'latched') releaseAll() // a held key must not move the robot right after the release
    map.setRobot(now)
    cameras.setStatus(now.world?.cameras ?? [])
    showGate(now.state, viewOnly())
    showFigures(now.state, now)
    showSafety(now.safety, about.body)
    arm.setState(now.state)
    setText($('tool-place'), toolText(now.tool))
    armHold.setState(now.state)
    $('stick').classList.toggle('off', !mayDrive())
  },
  scan: (head, ranges) => map.setScan(head, ranges),
  map: (head, cells) => map.setMap(head, cells),
  task(status) {
    map.setTask(status)
    showTask(status, viewOnly())
  },
  health(health) {
    showHealth(health)
    cameras.add(publishedCameras())
  },
  log: showLogLine,
  image: (data) => cameras.image(data),
  camera: (news) => cameras.setProblem(news),
  found: (found) => cameras.found(found),
  contours: (contours) => objects.setContours(contours),
  perceived: (found) => objects.setPerceived(found),
  objects: (stored) => objects.set(stored),
  armPlan: (plan) => world.setPlan(plan),
  scene(scene) {
    world.setScene(scene)
    $('show-world').hidden = false
    showWorldOfArm()
  },
  zones: (now) => zones.set(now),
  poses: (version, poses) => world.setPoses(version, poses),
  reply: showReply,
  connection(status) {
    const live = status === 'live'
    setText($('link'), live ? `live${robot?.viewers > 1 ? ` · ${robot.viewers} viewers` : ''}` : status)
    $('link').classList.toggle('live', live)
    document.body.classList.toggle('silent', !live)
    if (!live) {
      connectionLost ||= status === 'offline'
      releaseAll()
      robot = null
      arm.setState(null)
      setText($('tool-place'), '')
      armHold.setState(null)
      showGate(null, viewOnly())
      showFigures(null, {})
      showSafety(null, about.body)
      setText($('doing'), status === 'offline' ? 'no connection to the page’s server; retrying' : 'no messages from the page’s server')
    }
  },
  login() { $('login').showModal() },
}, stored('token'))

const settings = new Settings((what, more) => link.request(what, more))

const drive = new Drive({
  stick: $('stick'),
  speedShare: () => $('speed-share').value / 100,
  limits: () => ({ x: about.body?.max_linear_speed ?? 0, y: about.body?.max_lateral_speed ?? 0, z: about.body?.max_angular_speed ?? 0 }),
  send: (x, y, z) => link.drive(x, y, z),
  stop: () => stop(),
  allowed: () => mayDrive() && !isArmAlone(),
  show(wanted) {
    setText($('wanted'), wanted ? `${wanted[0].toFixed(2)} m/s · ${wanted[2].toFixed(2)} rad/s` : 'released')
  },
})

const arm = new Arm({
  list: $('joints'),
  speedShare: () => $('jog-share').value / 100,
  tool: $('tool'),
  send: (speeds, tool) => link.jog(speeds, tool),
  allowed: mayDrive,
  show: (text) => setText($('arm-status'), text),
})

const armHold = new ArmHold({
  hold: $('arm-hold'), limp: $('arm-limp'), ask: $('let-go'), yes: $('let-go-yes'), no: $('let-go-no'), request,
})

onLostRelease(releaseAll)

/** Forget the data that a server sends only on changes, and at the start of a connection. */
function forget() {
  map.forget()
  zones.set({ zones: [], places: [], map: '' })
  objects.set({ objects: [], tags: [] })
}

/** Show the controls of this body: for its base, its joints, or both. */
function showDrives(body) {
  arm.setJoints(body?.joints ?? [])
  $('arm').hidden = !body?.joints.length
  document.body.classList.toggle('arm-alone', isArmAlone())
  showWorldOfArm()
}

/** Show an arm without a base in three dimensions, as a map cannot show it. */
function showWorldOfArm() {
  if (!isArmAlone() || !world.scene || world.shown) return
  world.closeTo(ARM_DISTANCE_M)
  $('show-world').click()
}

function isArmAlone() { return about.body?.drive_type === 'arm' }

function releaseAll() {
  drive.releaseAll()
  arm.releaseAll()
}

function viewOnly() { return about.role !== 'operator' }

function mayDrive() {
  const gate = robot?.state?.gate
  return !viewOnly() && gate?.mode === 'enabled' && gate.commander === 'control'
}

async function stop() {
  if (viewOnly()) return
  releaseAll()
  const startMs = performance.now()
  show($('confirmed'), 'stopping …', '')
  const reply = await link.request('estop')
  if (reply.ok) return show($('confirmed'), `CONFIRMED by ${reply.robot} in ${(performance.now() - startMs).toFixed(0)} ms: ${reply.text}`, 'ok')
  const text = reply.not_confirmed ? reply.text : `NOT CONFIRMED: ${reply.text}; ${STOP_BY_HAND}`
  show($('confirmed'), text, 'bad')
}

async function request(what, more = {}) {
  releaseAll()
  const generation = robot?.state?.gate.estop_generation ?? 0
  const reply = await link.request(what, what === 'release' ? { estop_generation: generation } : more)
  showReply(reply)
  if (reply.ok && what === 'release') show($('confirmed'), '', '')
}

function showReply(reply) {
  show($('reply'), reply.text, `note${reply.ok ? '' : ' bad'}`)
}

function sendGoal({ x, y, yaw }) { return requestGoal({ x, y, yaw }, { x, y, yaw }) }

/** Send a goal. It is drawn at `place` until the robot answers. */
async function requestGoal(goal, place) {
  if (viewOnly()) return
  map.goal = place
  show($('goal'), 'sending the goal …', 'note')
  const reply = await link.request('goal', { goal })
  if (!reply.ok) map.goal = map.task?.goal ?? null
  show($('goal'), reply.text, `note${reply.ok ? '' : ' bad'}`)
  map.draw()
}

function show(element, text, kind) {
  setText(element, text)
  element.className = kind
}

$('estop').addEventListener('pointerdown', (event) => { event.preventDefault(); stop() })
$('estop').addEventListener('click', (event) => { if (event.detail === 0) stop() }) // from the keyboard or a screen reader
for (const what of ['release', 'enable', 'take', 'cancel']) $(what).addEventListener('click', () => request(what))
for (const [slider, percent] of [['speed-share', 'percent'], ['jog-share', 'jog-percent']]) {
  $(slider).addEventListener('input', () => setText($(percent), `${$(slider).value} %`))
}
const view = () => (world.shown ? world : map)
$('zoom-in').addEventListener('click', () => view().zoom(1.3))
$('zoom-out').addEventListener('click', () => view().zoom(1 / 1.3))
for (const [id, option] of [['follow', 'follow'], ['move-map', 'dragMoves']]) {
  $(id).addEventListener('click', () => {
    world[option] = map[option] = !map[option]
    $(id).setAttribute('aria-pressed', map[option])
  })
}
$('show-world').addEventListener('click', () => {
  const problem = world.show(!world.shown)
  if (problem) show($('goal'), problem, 'note bad')
  $('show-world').setAttribute('aria-pressed', world.shown)
  $('world-tools').hidden = !world.shown || viewOnly()
  $('move-map').hidden = document.querySelector('.legend').hidden = world.shown
})
const tools = [...document.querySelectorAll('[data-tool]')]
for (const button of tools) button.addEventListener('click', () => {
  world.tool = world.tool === button.dataset.tool ? '' : button.dataset.tool
  $('world').classList.toggle('placing', world.tool !== '')
  for (const each of tools) each.setAttribute('aria-pressed', each.dataset.tool === world.tool)
})
$('login').addEventListener('close', () => { link.token = $('token').value; store('token', link.token); link.open() })

$('theme').addEventListener('click', () => {
  const root = document.documentElement
  const dark = root.dataset.theme ? root.dataset.theme === 'dark' : matchMedia('(prefers-color-scheme: dark)').matches
  root.dataset.theme = dark ? 'light' : 'dark'
  try { localStorage.setItem('theme', root.dataset.theme) } catch { /* private mode */ }
  map.recolour()
  world.draw()
})
try { const theme = localStorage.getItem('theme'); if (theme) { document.documentElement.dataset.theme = theme; map.recolour() } } catch { /* private mode */ }
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => map.recolour())

const tabs = [...document.querySelectorAll('[role=tab]')]
function selectTab(tab) {
  for (const other of tabs) {
    other.setAttribute('aria-selected', other === tab)
    other.tabIndex = other === tab ? 0 : -1
    $(other.getAttribute('aria-controls')).hidden = other !== tab
  }
  showTables()
  showSettings()
}
function showSettings() {
  if (!$('settings').hidden && link.live && !viewOnly()) settings.refresh()
}
tabs.forEach((tab) => {
  tab.addEventListener('click', () => selectTab(tab))
  tab.addEventListener('keydown', (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key]
    if (!step) return
    const shown = tabs.filter((each) => !each.hidden), at = shown.indexOf(tab)
    const next = shown[(at + step + shown.length) % shown.length]
    next.focus()
    selectTab(next)
  })
})
setInterval(showTables, 1000)
setInterval(showSettings, 2000) // other clients may change them too
