// Connects the page: shows what the link receives, and sends what a person does.
import { Drive } from './drive.js'
import { Link } from './link.js'
import { MapView } from './map.js'
import { $, showHealth, showLogLine, put, showFigures, showGate, showImage, showSafety, showTables, showTask } from './panels.js'

const STOP_MS = 2500 // the server gives up after two seconds
const HANDS = 'press the hardware e-stop or cut the power'
const remembered = (key) => { try { return sessionStorage.getItem(key) ?? '' } catch { return '' } }
const remember = (key, value) => { try { sessionStorage.setItem(key, value) } catch { /* private mode */ } }

let about = { role: 'operator', body: null }
let moment = null

const given = decodeURIComponent(location.hash.slice(1))
if (given) { remember('token', given); history.replaceState(null, '', location.pathname) }

const map = new MapView($('map'), sendGoal)
const link = new Link({
  about(told) {
    about = told
    map.body = told.body
    put($('robot'), told.body ? `${told.body.robot_type} · ${told.link}` : 'gigabrain')
    document.title = `${told.body?.robot_type ?? 'gigabrain'}${looking() ? ' (view only)' : ''}`
    $('estop').disabled = looking()
    $('estop').querySelector('small').textContent = looking() ? 'view only: this token cannot stop the robot' : 'space bar'
  },
  moment(now) {
    moment = now
    if (now.state?.gate.mode === 'latched') drive.letGo() // a held key must not move the robot right after the release
    map.setMoment(now)
    showGate(now.state, looking())
    showFigures(now.state, now)
    showSafety(now.safety, about.body)
    $('stick').classList.toggle('off', !mayDrive())
  },
  scan: (head, ranges) => map.setScan(head, ranges),
  map: (head, cells) => map.setMap(head, cells),
  task(status) {
    map.setTask(status)
    showTask(status, looking())
  },
  health: showHealth,
  log: showLogLine,
  image: showImage,
  told: (reply) => say(reply),
  state(word) {
    const live = word === 'live'
    put($('link'), live ? `live${moment?.viewers > 1 ? ` · ${moment.viewers} viewers` : ''}` : word)
    $('link').classList.toggle('live', live)
    document.body.classList.toggle('silent', !live)
    if (!live) {
      drive.letGo()
      moment = null
      showGate(null, looking())
      showFigures(null, {})
      showSafety(null, about.body)
      put($('doing'), word === 'offline' ? 'no connection to the page’s server; retrying' : 'no messages from the page’s server')
    }
  },
  login() { $('login').showModal() },
}, remembered('token'))

const drive = new Drive({
  stick: $('stick'),
  share: () => $('share').value / 100,
  limits: () => ({ x: about.body?.max_linear_speed ?? 0, y: about.body?.max_lateral_speed ?? 0, z: about.body?.max_angular_speed ?? 0 }),
  send: (x, y, z) => link.drive(x, y, z),
  stop: () => stop(),
  allowed: mayDrive,
  show(wanted) {
    put($('wanted'), wanted ? `${wanted[0].toFixed(2)} m/s  ${wanted[2].toFixed(2)} rad/s` : 'released')
  },
})

function looking() { return about.role !== 'operator' }

function mayDrive() {
  const gate = moment?.state?.gate
  return !looking() && gate?.mode === 'enabled' && gate.commander === 'control'
}

async function stop() {
  if (looking()) return
  drive.letGo()
  const began = performance.now()
  show($('confirmed'), 'stopping …', '')
  const reply = await link.ask('estop', {}, STOP_MS)
  if (reply.ok) return show($('confirmed'), `CONFIRMED by ${reply.robot} in ${(performance.now() - began).toFixed(0)} ms: ${reply.text}`, 'ok')
  const why = reply.text.startsWith('NOT CONFIRMED') ? reply.text : `NOT CONFIRMED: ${reply.text}; ${HANDS}`
  show($('confirmed'), why, 'bad')
}

async function ask(what) {
  drive.letGo()
  const generation = moment?.state?.gate.estop_generation ?? 0
  const reply = await link.ask(what, what === 'release' ? { estop_generation: generation } : {})
  say(reply)
  if (reply.ok && what === 'release') show($('confirmed'), '', '')
}

function say(reply) {
  show($('said'), reply.text, `note${reply.ok ? '' : ' bad'}`)
}

async function sendGoal(goal) {
  if (looking()) return
  map.goal = goal
  show($('goal'), 'asking …', 'note')
  const reply = await link.ask('goal', { goal: { x: goal.x, y: goal.y, yaw: goal.yaw } })
  if (!reply.ok) map.goal = map.task?.goal ?? null
  show($('goal'), reply.text, `note${reply.ok ? '' : ' bad'}`)
  map.draw()
}

function show(element, text, kind) {
  put(element, text)
  element.className = kind
}

$('estop').addEventListener('pointerdown', (event) => { event.preventDefault(); stop() })
$('estop').addEventListener('click', (event) => { if (event.detail === 0) stop() }) // by keyboard or by a screen reader
for (const what of ['release', 'enable', 'take', 'cancel']) $(what).addEventListener('click', () => ask(what))
$('share').addEventListener('input', () => put($('percent'), `${$('share').value} %`))
$('closer').addEventListener('click', () => map.zoom(1.3))
$('farther').addEventListener('click', () => map.zoom(1 / 1.3))
for (const name of ['follow', 'grab']) {
  $(name).addEventListener('click', () => { map[name] = !map[name]; $(name).setAttribute('aria-pressed', map[name]) })
}
$('login').addEventListener('close', () => { link.token = $('token').value; remember('token', link.token); link.open() })

$('theme').addEventListener('click', () => {
  const root = document.documentElement
  const dark = root.dataset.theme ? root.dataset.theme === 'dark' : matchMedia('(prefers-color-scheme: dark)').matches
  root.dataset.theme = dark ? 'light' : 'dark'
  try { localStorage.setItem('theme', root.dataset.theme) } catch { /* private mode */ }
  map.recolour()
})
try { const theme = localStorage.getItem('theme'); if (theme) { document.documentElement.dataset.theme = theme; map.recolour() } } catch { /* private mode */ }
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => map.recolour())

const tabs = [...document.querySelectorAll('[role=tab]')]
function choose(tab) {
  for (const other of tabs) {
    other.setAttribute('aria-selected', other === tab)
    other.tabIndex = other === tab ? 0 : -1
    $(other.getAttribute('aria-controls')).hidden = other !== tab
  }
  showTables()
}
tabs.forEach((tab, i) => {
  tab.addEventListener('click', () => choose(tab))
  tab.addEventListener('keydown', (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key]
    if (!step) return
    const next = tabs[(i + step + tabs.length) % tabs.length]
    next.focus()
    choose(next)
  })
})
setInterval(showTables, 1000)
