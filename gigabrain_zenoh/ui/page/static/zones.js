// Zones and named places on the map, which a person adds and removes; and the saved maps.
import { $, setText } from './panels.js'

const TAU = 2 * Math.PI
const MAX_HIT_PX = 14 // from a place or a lane to a click on it
const MIN_POINTS = { keepout: 3, speed: 3, one_way: 2 }
const COLOUR = { keepout: 'scan', speed: 'zone', one_way: 'plan' }
const STEPS_PER_M = 1000 // coordinates are rounded to millimetres
const HINTS = {
  keepout: 'Click the corners of the zone, then Finish.',
  speed: 'Click the corners of the zone, then Finish.',
  one_way: 'Click from the start of the lane to its end, then Finish.',
  place: 'Click the place; drag to set its heading.',
  remove: 'Click a zone or a place to remove it.',
}

/** Return whether a point is in a polygon, by the even-odd rule. */
const contains = (points, x, y) => points.reduce((inside, [ax, ay], i) => {
  const [bx, by] = points[(i + 1) % points.length]
  return (ay > y) !== (by > y) && x < ax + ((y - ay) / (by - ay)) * (bx - ax) ? !inside : inside
}, false)

/** Return the distance from a point to a polyline. */
const distance = (points, x, y) => Math.min(...points.slice(1).map(([bx, by], i) => {
  const [ax, ay] = points[i], dx = bx - ax, dy = by - ay
  const share = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)))
  return Math.hypot(x - ax - share * dx, y - ay - share * dy)
}))

const rounded = (value) => Math.round(value * STEPS_PER_M) / STEPS_PER_M

export class Zones {
  #points = [] // of the zone that is being drawn
  #tool = ''

  /** `request(what, more)` resolves to the robot's reply; `say(text, ok)` shows a text. */
  constructor(map, { request, say }) {
    Object.assign(this, { map, request, say, zones: [], places: [] })
    map.layers.push((pen) => this.#paint(pen))
    for (const button of document.querySelectorAll('[data-zone]')) button.addEventListener('click', () => this.#choose(button.dataset.zone))
    $('zone-finish').addEventListener('click', () => this.#finish())
    $('edit-zones').addEventListener('click', () => this.edit($('zone-tools').hidden))
    $('map-save').addEventListener('click', () => this.#save())
    $('map-load').addEventListener('click', () => this.#load())
    addEventListener('keydown', (event) => { if (event.key === 'Escape' && this.#tool) this.#choose('') })
  }

  set({ zones, places, map }) {
    Object.assign(this, { zones, places })
    setText($('map-name'), map ? `map: ${map}` : 'map not saved')
    this.map.draw()
  }

  /** Show or hide the tools. */
  edit(on) {
    $('zone-tools').hidden = !on
    $('edit-zones').setAttribute('aria-pressed', on)
    this.#choose('')
    if (on) this.#list()
  }

  #choose(tool) {
    this.#tool = tool === this.#tool ? '' : tool
    this.#points = []
    this.map.tool = this.#tool ? (place) => this.#click(place) : null
    for (const button of document.querySelectorAll('[data-zone]')) button.setAttribute('aria-pressed', button.dataset.zone === this.#tool)
    $('zone-finish').hidden = !(this.#tool in MIN_POINTS)
    $('zone-value-label').hidden = !['speed', 'one_way'].includes(this.#tool)
    setText($('zone-unit'), this.#tool === 'speed' ? 'at most [m/s]' : 'width [m]')
    $('zone-value').value = this.#tool === 'speed' ? '0.1' : '1.0'
    if (this.#tool) this.say(HINTS[this.#tool], true)
    this.map.draw()
  }

  #click({ x, y, yaw }) {
    if (this.#tool === 'remove') return this.#remove(x, y)
    if (this.#tool === 'place') return this.#put({ place: { name: this.#name('place'), x: rounded(x), y: rounded(y), yaw } })
    this.#points.push([rounded(x), rounded(y)])
    this.map.draw()
  }

  #finish() {
    const kind = this.#tool, missing = MIN_POINTS[kind] - this.#points.length
    if (missing > 0) return this.say(`${missing} more ${missing > 1 ? 'points are' : 'point is'} needed`, false)
    const value = Number($('zone-value').value)
    const zone = { name: this.#name(kind), kind, points: this.#points }
    if (kind === 'speed') zone.max_speed = value
    if (kind === 'one_way') zone.lane_width = value
    this.#put({ zone })
  }

  /** Return the name that was typed, or the first free one. */
  #name(kind) {
    const typed = $('zone-name').value.trim()
    if (typed) return typed
    const taken = new Set([...this.zones, ...this.places].map((one) => one.name))
    for (let number = 1; ; number++) if (!taken.has(`${kind} ${number}`)) return `${kind} ${number}`
  }

  async #put(change) {
    const reply = await this.request('zones', { zones: change })
    this.say(reply.text, reply.ok)
    if (!reply.ok) return
    this.#points = []
    $('zone-name').value = ''
    this.map.draw()
  }

  async #remove(x, y) {
    const near = MAX_HIT_PX * this.map.pixel
    const place = this.places.find((one) => Math.hypot(one.x - x, one.y - y) < near)
    const zone = this.zones.findLast((one) => (one.kind === 'one_way' ? distance(one.points, x, y) < Math.max(near, one.lane_width / 2) : contains(one.points, x, y)))
    const found = place ?? zone
    if (!found) return this.say('there is no zone or place to remove', false)
    const reply = await this.request('zones', { zones: { remove: found.name } })
    this.say(reply.text, reply.ok)
  }

  async #list() {
    const reply = await this.request('maps')
    if (!reply.ok) return this.say(reply.text, false)
    const chosen = $('maps').value
    $('maps').replaceChildren(...reply.maps.map((one) => {
      const option = document.createElement('option')
      option.textContent = option.value = one.name
      option.disabled = one.problem !== ''
      option.title = one.problem
      return option
    }))
    if (chosen) $('maps').value = chosen
    $('map-load').disabled = !$('maps').value
  }

  async #save() {
    const name = $('map-save-name').value.trim()
    if (!name) return this.say('enter a name for the map', false)
    this.say('saving the map …', true)
    let reply = await this.request('map_save', { name })
    if (!reply.ok && reply.text.includes('there is a map') && confirm(`Replace the map ${name}?`)) reply = await this.request('map_save', { name, value: 'replace' })
    this.say(reply.text, reply.ok)
    this.#list()
  }

  async #load() {
    const name = $('maps').value
    if (!confirm(`Load the map ${name}? All tasks are cancelled.`)) return
    this.say('loading the map …', true)
    const reply = await this.request('map_load', { name })
    this.say(reply.text, reply.ok)
  }

  #paint(pen) {
    for (const zone of this.zones) this.#paintZone(pen, zone)
    if (this.#points.length) this.#paintZone(pen, { kind: this.#tool, points: this.#points, name: '', lane_width: Number($('zone-value').value) })
    for (const place of this.places) this.#paintPlace(pen, place)
  }

  #paintZone(pen, zone) {
    const { map } = this, colour = map.colour[COLOUR[zone.kind]], lane = zone.kind === 'one_way'
    pen.beginPath()
    zone.points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)))
    if (lane) {
      pen.lineJoin = 'round'
      pen.globalAlpha = 0.18
      pen.strokeStyle = colour
      pen.lineWidth = zone.lane_width
      pen.stroke()
      pen.globalAlpha = 1
      map.stroke(pen, colour, 1)
      this.#paintArrows(pen, zone.points, colour)
    } else {
      pen.closePath()
      pen.globalAlpha = 0.25
      pen.fillStyle = colour
      pen.fill()
      pen.globalAlpha = 1
      map.stroke(pen, colour, 2)
    }
    const count = zone.points.length, sum = zone.points.reduce((a, p) => [a[0] + p[0], a[1] + p[1]], [0, 0])
    const text = zone.max_speed ? `${zone.name} ${zone.max_speed} m/s` : zone.name
    this.map.label(pen, text, sum[0] / count, sum[1] / count)
  }

  #paintArrows(pen, points, colour) {
    const size = 9 * this.map.pixel
    points.slice(1).forEach(([x, y], i) => {
      const [ax, ay] = points[i], yaw = Math.atan2(y - ay, x - ax)
      for (const share of [0.25, 0.5, 0.75, 1]) {
        const px = ax + share * (x - ax), py = ay + share * (y - ay)
        pen.beginPath()
        pen.moveTo(px, py)
        for (const side of [1, -1]) pen.lineTo(px - size * Math.cos(yaw + side * 0.5), py - size * Math.sin(yaw + side * 0.5))
        pen.closePath()
        pen.fillStyle = colour
        pen.fill()
      }
    })
  }

  #paintPlace(pen, { name, x, y, yaw }) {
    const { map } = this, size = 6 * map.pixel
    pen.beginPath()
    pen.arc(x, y, size, 0, TAU)
    pen.fillStyle = map.colour.plan
    pen.fill()
    if (yaw != null) {
      pen.moveTo(x, y)
      pen.lineTo(x + 3 * size * Math.cos(yaw), y + 3 * size * Math.sin(yaw))
    }
    map.stroke(pen, map.colour.plan, 2)
    this.map.label(pen, name, x, y + 2.5 * size)
  }
}
