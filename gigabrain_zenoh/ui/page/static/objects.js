// Findings of cameras and perceptors on the map: contours, things, tags. A click on a thing offers to go there.
import { paintDisc, toFrameOf } from './layers.js'
import { $, fillTable, makeElement, setText } from './panels.js'

const TAU = 2 * Math.PI
const MAX_HIT_PX = 14 // from a thing to a click on it
const OVERHANG_M = 0.1, HOLE_M = -0.01 // the same limits as in recordings
const FADE_S = 10, MIN_ALPHA = 0.15 // a contour fades after it was last seen
const PERCEIVED_SHOWN_MS = 1000
const STANDOFF_M = 0.3 // between the robot's outline and a thing that it drives to
const DIRECTIONS = 24 // to try around a thing
const OCCUPIED_PERCENT = 50 // least value of an occupied cell
const LAYERS = ['contours', 'objects', 'perceived'] // with a switch in the legend

const kindOf = ({ bottom }) => (bottom < HOLE_M ? 'hole' : bottom > OVERHANG_M ? 'overhang' : 'low')
const isTag = (thing) => thing.label === undefined
const nameOf = (thing) => (isTag(thing) ? `tag ${thing.id}` : `${thing.label} ${thing.id}`)

/** Return whether all cells of a map within `reach` of a point are known and free. */
function isFree(map, x, y, reach) {
  const cells = Math.ceil(reach / map.resolution), column = Math.floor((x - map.x) / map.resolution), row = Math.floor((y - map.y) / map.resolution)
  for (let dy = -cells; dy <= cells; dy++) {
    for (let dx = -cells; dx <= cells; dx++) {
      if (Math.hypot(dx, dy) > cells) continue
      const [c, r] = [column + dx, row + dy], cell = map.cells[r * map.width + c]
      if (c < 0 || r < 0 || c >= map.width || r >= map.height || cell < 0 || cell >= OCCUPIED_PERCENT) return false
    }
  }
  return true
}

/** Return the free pose in front of a thing, facing it, that is nearest to the robot; null if there is none. */
export function placeBefore(thing, robot, map, reach) {
  const away = thing.size[0] / 2 + reach + STANDOFF_M, towards = Math.atan2(robot.y - thing.y, robot.x - thing.x)
  for (let i = 0; i < DIRECTIONS; i++) {
    const angle = towards + Math.ceil(i / 2) * (i % 2 ? 1 : -1) * (TAU / DIRECTIONS)
    const x = thing.x + away * Math.cos(angle), y = thing.y + away * Math.sin(angle)
    if (!map || isFree(map, x, y, reach)) return { x, y, yaw: Math.atan2(thing.y - y, thing.x - x) }
  }
  return null
}

export class Objects {
  #offered = null
  #contours = []
  #perceived = new Map() // by perceptor: objects and their arrival in ms
  #shown = Object.fromEntries(LAYERS.map((layer) => [layer, true]))

  /** `go(goal, place)` sends a goal; `allowed()` returns whether this viewer may. */
  constructor(map, { go, allowed }) {
    Object.assign(this, { map, go, allowed, things: [] })
    map.layers.push((pen) => this.#paintThings(pen))
    map.robotLayers.push((pen) => this.#paintContours(pen), (pen) => this.#paintPerceived(pen))
    map.pick = ({ x, y }) => this.#pick(x, y)
    for (const layer of LAYERS) $(`show-${layer}`).addEventListener('click', () => {
      this.#shown[layer] = !this.#shown[layer]
      $(`show-${layer}`).setAttribute('aria-pressed', this.#shown[layer])
      map.draw()
    })
    $('offer-go').addEventListener('click', () => this.#go(this.#offered))
    $('offer-close').addEventListener('click', () => this.#offer(null))
    addEventListener('keydown', (event) => { if (event.key === 'Escape' && this.#offered) this.#offer(null) })
    setInterval(() => this.#fillTable(), 1000)
  }

  set({ objects, tags }) {
    this.things = [...objects, ...tags.map((tag) => ({ ...tag, size: [tag.size, tag.size] }))]
    this.#reveal('objects', this.things.length > 0)
    $('tab-objects').hidden = $('show-objects').hidden
    if (this.#offered) this.#offer(this.things.find((thing) => nameOf(thing) === nameOf(this.#offered)) ?? null)
    this.#fillTable()
    this.map.draw()
  }

  setContours(contours) {
    this.#contours = contours
    this.#reveal('contours', contours.length > 0)
    this.map.draw()
  }

  setPerceived({ name, objects }) {
    this.#perceived.set(name, [objects, performance.now()])
    this.#reveal('perceived', objects.length > 0)
    this.map.draw()
  }

  /** Show the switch of a layer from its first content on. */
  #reveal(layer, hasContent) { if (hasContent) $(`show-${layer}`).hidden = false }

  #inMap() { return this.map.robot?.frame === 'map' }

  #pick(x, y) {
    if (!this.#shown.objects || !this.#inMap()) return false
    const off = (thing) => Math.hypot(thing.x - x, thing.y - y)
    const near = this.things.filter((thing) => off(thing) < Math.max(MAX_HIT_PX * this.map.pixel, thing.size[0] / 2))
    const [picked] = near.sort((one, other) => off(one) - off(other))
    this.#offer(picked ?? null)
    return Boolean(picked)
  }

  #offer(thing) {
    const isNew = thing && !this.#offered
    this.#offered = thing
    $('offer').hidden = !thing
    if (!thing) return
    setText($('offer-text'), about(thing))
    setText($('offer-go'), `Go to ${nameOf(thing)}`)
    $('offer-go').hidden = !this.allowed()
    if (isNew) (this.allowed() ? $('offer-go') : $('offer-close')).focus()
  }

  #go(thing) {
    this.#offer(null)
    if (!thing) return
    const { pose } = this.map.robot ?? {}, reach = Math.max(...(this.map.body?.footprint ?? [[0.2, 0]]).map((corner) => Math.hypot(...corner)))
    const place = pose ? placeBefore(thing, pose, this.map.map, reach) : null
    const alone = !isTag(thing) && this.things.filter((other) => other.label === thing.label).length === 1
    const round = (value) => Math.round(value * 1000) / 1000
    if (isTag(thing)) this.go({ tag: thing.id }, place)
    else if (alone || !place) this.go({ object: thing.label }, place) // decision finds a pose in front of it
    else this.go({ x: round(place.x), y: round(place.y), yaw: round(place.yaw) }, place)
  }

  #fillTable() {
    if ($('objects').hidden) return
    const focused = document.activeElement?.dataset.thing
    fillTable($('objects'), this.things.map((thing) => ({ cells: cellsOf(thing), numbers: [1, 2, 3, 4] })))
    if (!this.allowed()) return
    $('objects').querySelectorAll('tbody tr').forEach((row, i) => {
      const button = makeElement('button', 'go'), name = nameOf(this.things[i])
      button.dataset.thing = name
      button.setAttribute('aria-label', `Go to ${name}`)
      button.addEventListener('click', () => this.#go(this.things[i]))
      row.insertCell().append(button)
      if (focused === name) button.focus()
    })
  }

  #paintContours(pen) {
    if (!this.#shown.contours) return
    for (const contour of this.#contours) {
      const colour = this.map.colour[kindOf(contour)]
      pen.beginPath()
      contour.polygon.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)))
      pen.closePath()
      const alpha = Math.max(MIN_ALPHA, contour.confidence * Math.max(0, 1 - contour.age / FADE_S))
      pen.globalAlpha = alpha / 3
      pen.fillStyle = colour
      pen.fill()
      pen.globalAlpha = alpha
      this.map.stroke(pen, colour, 2)
    }
    pen.globalAlpha = 1
  }

  /** Paint the findings of perceptors, which are in the odometry frame like obstacles. */
  #paintPerceived(pen) {
    const { state } = this.map.robot
    if (!state || !this.#shown.perceived) return
    const toRobot = toFrameOf(state.pose), rotate = toFrameOf({ x: 0, y: 0, yaw: state.pose.yaw })
    for (const [objects, arrivedMs] of this.#perceived.values()) {
      if (performance.now() - arrivedMs > PERCEIVED_SHOWN_MS) continue
      for (const one of objects) {
        const [x, y] = toRobot([one.x, one.y])
        paintDisc(pen, this.map, x, y, one.radius, rotate([one.velocity_x, one.velocity_y]))
        this.map.label(pen, one.label, x, y, this.map.robot.pose.yaw)
      }
    }
  }

  #paintThings(pen) {
    if (!this.#shown.objects || !this.#inMap()) return
    for (const thing of this.things) {
      if (isTag(thing)) this.#paintTag(pen, thing)
      else this.#paintThing(pen, thing)
      const below = Math.max(thing.size[0] / 2, 6 * this.map.pixel) + 8 * this.map.pixel
      this.map.label(pen, nameOf(thing), thing.x, thing.y - below)
    }
  }

  #paintThing(pen, thing) {
    const { map } = this
    pen.beginPath()
    pen.arc(thing.x, thing.y, Math.max(thing.size[0] / 2, 5 * map.pixel), 0, TAU)
    pen.globalAlpha = 0.3 + 0.5 * thing.confidence
    pen.fillStyle = map.colour.thing
    pen.fill()
    pen.globalAlpha = 1
    map.stroke(pen, map.colour.ink, thing === this.#offered ? 3 : 1)
  }

  /** Paint a square, and a line in the direction of the tag's face. */
  #paintTag(pen, tag) {
    const { map } = this, side = Math.max(tag.size[0], 9 * map.pixel)
    pen.save()
    pen.translate(tag.x, tag.y)
    pen.rotate(tag.yaw)
    pen.fillStyle = map.colour.ink
    pen.fillRect(-side / 2, -side / 2, side, side)
    pen.fillStyle = map.colour.floor
    pen.fillRect(-side / 6, -side / 6, side / 3, side / 3)
    pen.beginPath()
    pen.moveTo(side / 2, 0)
    pen.lineTo(1.6 * side, 0)
    map.stroke(pen, map.colour.ink, 2)
    pen.restore()
  }
}

function cellsOf(thing) {
  const [width, height] = thing.size.map((metres) => `${(100 * metres).toFixed(0)} cm`)
  return [nameOf(thing), `${thing.x.toFixed(2)}, ${thing.y.toFixed(2)} m`, `${width} × ${height}`, isTag(thing) ? '' : `${Math.round(100 * thing.confidence)} %`, String(thing.seen), seenAt(thing)]
}

function seenAt({ last_seen_ns: at }) {
  return at ? new Date(at / 1e6).toLocaleTimeString([], { hour12: false }) : ''
}

function about(thing) {
  const [name, place, size, confidence, seen, when] = cellsOf(thing)
  return [name, confidence, size, `at ${place}`, `seen in ${seen} pictures${when ? `, last at ${when}` : ''}`].filter(Boolean).join(' · ')
}
