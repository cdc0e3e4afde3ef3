// The simulated world in three dimensions: turn it, and put obstacles and people into it.
import { planMarks } from './arm_plan.js'
import { Camera, matrixOf, Renderer } from './world_gl.js'

const ORIGIN_POSE = [0, 0, 0, 1, 0, 0, 0]
const MAX_CLICK_PX = 5 // a longer drag is no click
const MIN_WALK_M = 0.3 // a shorter drag adds a person that stands
const MIN_HIT_RADIUS_M = 0.4 // from a thing's middle to a click on it
const SIZES = { box: [0.3, 0.3, 0.5], cylinder: [0.3, 0.3, 0.5] }
const CLOSE_ELEVATION = 0.5 // [rad]
const CLOSE_HEIGHT_M = 0.12 // of the camera's target
const ROBOT = 'robot/', BASE = 'robot/base'

const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0))
const floatsOf = (base64) => new Float32Array(bytesOf(base64).buffer)

export class WorldView {
  #camera = new Camera()
  #matrices = []
  #pointers = new Map()
  #drag = null
  #drawScheduled = false
  #renderer = null
  #marks = [] // of the arm's plan
  #height = 0

  /** `change(request)` asks the simulation for a change of its world; `say(text, ok)` shows a result. */
  constructor(canvas, { change, say }) {
    this.canvas = canvas
    this.change = change
    this.say = say
    this.scene = null
    this.follow = true
    this.tool = '' // '', box, cylinder, person or remove
    new ResizeObserver(() => this.draw()).observe(canvas)
    this.#listen()
  }

  get shown() { return !this.canvas.hidden }

  /** Show or hide it; return the reason if it cannot be shown. */
  show(shown) {
    try {
      if (shown && !this.#renderer) {
        this.#renderer = new Renderer(this.canvas)
        this.#renderer.mark(this.#marks)
      }
    } catch (error) {
      return error.message
    }
    this.canvas.hidden = !shown
    if (shown) this.#load()
    return ''
  }

  setScene(scene) {
    this.scene = {
      ...scene,
      kinds: bytesOf(scene.kinds), owners: new Uint16Array(bytesOf(scene.owners).buffer), sizes: floatsOf(scene.sizes),
      places: floatsOf(scene.places), colours: bytesOf(scene.colours),
      meshes: scene.meshes.map((one) => ({ vertices: floatsOf(one.vertices), faces: new Uint32Array(bytesOf(one.faces).buffer) })),
    }
    this.#matrices = [matrixOf(ORIGIN_POSE)]
    if (this.shown) this.#load()
  }

  /** Show the planned path of the arm's tool, and the grasps. */
  setPlan(plan) {
    this.#marks = planMarks(plan)
    this.#renderer?.mark(this.#marks)
    this.draw()
  }

  setPoses(version, poses) {
    if (!this.scene || version !== this.scene.version % 2 ** 32) return
    for (let i = 0; 7 * i < poses.length; i++) this.#matrices[i + 1] = matrixOf([...poses.subarray(7 * i, 7 * i + 7)])
    const { bodies } = this.scene, robot = bodies.includes(BASE) ? bodies.indexOf(BASE) : bodies.findIndex((name) => name.startsWith(ROBOT))
    const base = this.#matrices[robot]
    if (this.follow && base) this.#camera.target = [base[12], base[13], this.#height]
    this.draw()
  }

  /** Look from this distance [m]. */
  closeTo(distance) {
    this.#camera.distance = distance
    this.#height = CLOSE_HEIGHT_M
    this.#camera.elevation = CLOSE_ELEVATION
  }

  zoom(factor) {
    this.#camera.distance = Math.min(60, Math.max(0.5, this.#camera.distance / factor))
    this.draw()
  }

  draw() {
    if (this.#drawScheduled || !this.shown || !this.#renderer) return
    this.#drawScheduled = true
    requestAnimationFrame(() => { this.#drawScheduled = false; this.#paint() })
  }

  #load() {
    if (!this.scene) return
    this.#renderer.load(this.scene)
    this.draw()
  }

  #paint() {
    const ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = this.canvas
    this.canvas.width = Math.max(1, Math.round(w * ratio))
    this.canvas.height = Math.max(1, Math.round(h * ratio))
    const floor = getComputedStyle(this.canvas).getPropertyValue('--floor').trim()
    const background = [1, 3, 5].map((i) => parseInt(floor.slice(i, i + 2), 16) / 255)
    this.#renderer.draw(this.#camera, this.#matrices, background, this.scene?.bodies.indexOf(BASE))
  }

  /** Return the place on the floor under the pointer, or null. */
  #floorAt(event) {
    const area = this.canvas.getBoundingClientRect()
    const x = (2 * (event.clientX - area.left)) / area.width - 1, y = 1 - (2 * (event.clientY - area.top)) / area.height
    const ray = this.#camera.ray(x, y, area.width / area.height), eye = this.#camera.eye
    if (ray[2] > -0.01) return null
    const distance = -eye[2] / ray[2]
    return [eye[0] + distance * ray[0], eye[1] + distance * ray[1]]
  }

  #listen() {
    const on = (name, act, options) => this.canvas.addEventListener(name, act, options)
    on('contextmenu', (event) => event.preventDefault())
    on('wheel', (event) => { event.preventDefault(); this.zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15) }, { passive: false })
    on('pointerdown', (event) => this.#down(event))
    on('pointermove', (event) => this.#move(event))
    on('pointerup', (event) => this.#up(event))
    on('pointercancel', (event) => { this.#pointers.delete(event.pointerId); this.#drag = null })
  }

  #down(event) {
    this.canvas.setPointerCapture(event.pointerId)
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
    const pans = event.shiftKey || event.button > 0
    this.#drag = { from: [event.clientX, event.clientY], place: this.#floorAt(event), pans, tool: pans ? '' : this.tool }
  }

  #move(event) {
    const before = this.#pointers.get(event.pointerId)
    if (!before || !this.#drag) return
    const now = [event.clientX, event.clientY], others = [...this.#pointers].filter(([id]) => id !== event.pointerId)
    const dx = now[0] - before[0], dy = now[1] - before[1]
    if (others.length) {
      const distance = (p) => Math.hypot(p[0] - others[0][1][0], p[1] - others[0][1][1])
      this.zoom(distance(now) / Math.max(1, distance(before)))
      this.#drag.tool = 'none'
    } else if (this.#drag.pans) this.#pan(dx, dy)
    else if (!this.#drag.tool) {
      this.#camera.azimuth -= dx * 0.008
      this.#camera.elevation = Math.min(1.55, Math.max(0.05, this.#camera.elevation + dy * 0.008))
    }
    this.#pointers.set(event.pointerId, now)
    this.draw()
  }

  #pan(dx, dy) {
    this.follow = false
    document.getElementById('follow').setAttribute('aria-pressed', false)
    const { right, back } = this.#camera.axes, metres = this.#camera.distance / this.canvas.clientHeight
    const ahead = Math.hypot(back[0], back[1]) || 1, target = this.#camera.target
    this.#camera.target = [0, 1].map((i) => target[i] - metres * dx * right[i] - (metres * dy * back[i]) / ahead).concat(0)
  }

  #up(event) {
    this.#pointers.delete(event.pointerId)
    const drag = this.#drag
    this.#drag = null
    if (!drag?.place || !drag.tool || drag.tool === 'none') return
    const to = this.#floorAt(event), moved = Math.hypot(event.clientX - drag.from[0], event.clientY - drag.from[1]) > MAX_CLICK_PX
    if (drag.tool === 'remove') this.#remove(drag.place)
    else if (drag.tool === 'person') this.#add('person', drag.place, moved ? to : null)
    else this.#add(drag.tool, drag.place, null)
  }

  #add(kind, [x, y], to) {
    const walks = to && Math.hypot(to[0] - x, to[1] - y) > MIN_WALK_M
    this.#request({ do: 'add', thing: { kind, x, y, ...(SIZES[kind] && { size: SIZES[kind] }), ...(walks && { path: [to] }) } })
  }

  #remove([x, y]) {
    const near = this.scene.things.map(({ name, kind, size }) => {
      const { 12: at_x, 13: at_y } = this.#matrices[this.scene.bodies.indexOf(name)] ?? { 12: Infinity, 13: Infinity }
      const reach = kind === 'person' ? MIN_HIT_RADIUS_M : Math.max(MIN_HIT_RADIUS_M, Math.hypot(size[0], size[1]) / 2)
      return { name, distance: Math.hypot(at_x - x, at_y - y), reach }
    }).filter(({ distance, reach }) => distance <= reach).sort((a, b) => a.distance - b.distance)
    if (near.length) this.#request({ do: 'remove', name: near[0].name })
    else this.say('there is no added object at this place', false)
  }

  async #request(request) {
    const reply = await this.change(request)
    this.say(reply.text, reply.ok)
  }
}
