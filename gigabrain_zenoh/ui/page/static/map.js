// The map with the robot, its path and its goal. It is redrawn after each change.
import { ON_ROBOT } from './layers.js'

const TRACE_CELL_M = 0.05, TRACE_CELLS = 1200 // of the grid of past scans, which is shown without a map
const MIN_HEADING_DRAG_M = 0.1 // a shorter drag sets no heading
const MIN_STEP_M = 0.03 // between two points of the driven path
const MAX_TRAIL = 4000, TRAIL_CUT = 1000 // points of the driven path
const TAU = 2 * Math.PI
const COLOURS = ['floor', 'grid', 'scan', 'plan', 'zone', 'trail', 'trace', 'robot', 'obstacle', 'ink', 'low', 'overhang', 'hole', 'thing']

export class MapView {
  #scale = 90 // pixels per metre
  #centre = [0, 0]
  #drag = null
  #drawScheduled = false
  #pointers = new Map()
  #boot = null // the driver's start that the odometry belongs to

  constructor(canvas, onGoal) {
    this.canvas = canvas
    this.onGoal = onGoal
    this.layers = [] // functions that draw more, in the frame of the map [m]
    this.robotLayers = [] // the same, in the robot's frame
    this.tool = null // a function that receives clicks and drags instead of `onGoal`
    this.pick = null // a function that receives clicks first; returns true if it used one
    this.follow = true
    this.dragMoves = false // a drag moves the map and sets no goal
    this.robot = null
    this.forget()
    this.#clearOdometry()
    this.recolour()
    new ResizeObserver(() => this.draw()).observe(canvas)
    this.#listen()
  }

  /** Forget the map and the task. */
  forget() { this.map = this.goal = this.task = null }

  #clearOdometry() {
    this.trace = new OffscreenCanvas(TRACE_CELLS, TRACE_CELLS)
    this.trail = []
    this.scan = null
  }

  recolour() {
    const style = getComputedStyle(document.documentElement)
    this.colour = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]))
    this.#paintMap()
    this.draw()
  }

  setRobot(robot) {
    const boot = robot.state?.boot ?? this.#boot
    if (boot !== this.#boot) this.#clearOdometry()
    this.#boot = boot
    if (this.robot?.frame !== robot.frame) this.trail = []
    this.robot = robot
    const pose = robot.pose
    if (pose) {
      const last = this.trail.at(-1)
      if (!last || Math.hypot(pose.x - last[0], pose.y - last[1]) > MIN_STEP_M) this.trail.push([pose.x, pose.y])
      if (this.trail.length > MAX_TRAIL) this.trail.splice(0, TRAIL_CUT)
      if (this.follow) this.#centre = [pose.x, pose.y]
    }
    this.draw()
  }

  /** Head: robot x, y, yaw; lidar x, y, yaw; first angle, increment, greatest range. */
  setScan(head, ranges) {
    const [x, y, yaw, mx, my, myaw, first, step, maxRange] = head
    const points = []
    const lx = x + mx * Math.cos(yaw) - my * Math.sin(yaw), ly = y + mx * Math.sin(yaw) + my * Math.cos(yaw)
    ranges.forEach((range, i) => {
      if (!(range > 0 && range <= maxRange)) return
      const angle = yaw + myaw + first + i * step
      points.push([lx + range * Math.cos(angle), ly + range * Math.sin(angle)])
    })
    this.scan = points
    if (!this.map) this.#addToTrace(points)
  }

  setMap(head, cells) {
    const [resolution, x, y] = [0, 4, 8].map((at) => head.getFloat32(at, true))
    const [width, height] = [12, 16].map((at) => head.getUint32(at, true))
    this.map = { resolution, x, y, width, height, cells: cells.slice() }
    this.#paintMap()
    this.draw()
  }

  /** Set the path and the goal of the present task, in the map. */
  setTask(task) {
    this.task = task
    this.goal = task.goal
    this.draw()
  }

  zoom(factor) {
    this.#scale = Math.min(600, Math.max(8, this.#scale * factor))
    this.draw()
  }

  draw() {
    if (this.#drawScheduled) return
    this.#drawScheduled = true
    requestAnimationFrame(() => { this.#drawScheduled = false; this.#paint() })
  }

  #addToTrace(points) {
    const pen = this.trace.getContext('2d')
    pen.fillStyle = this.colour.trace
    for (const [x, y] of points) pen.fillRect(Math.round(TRACE_CELLS / 2 + x / TRACE_CELL_M), Math.round(TRACE_CELLS / 2 - y / TRACE_CELL_M), 1, 1)
  }

  #paintMap() {
    if (!this.map) return
    const { width, height, cells } = this.map
    this.picture = new OffscreenCanvas(width, height)
    const pen = this.picture.getContext('2d'), image = pen.createImageData(width, height)
    const dark = this.colour.floor < '#8'
    const bytes = new Uint8ClampedArray(4 * 256) // RGBA of each cell value; unknown cells are transparent
    for (let cell = 0; cell <= 100; cell++) {
      const grey = dark ? 30 + cell * 2 : 255 - cell * 2.4
      bytes.set([grey, grey, grey, 255], 4 * cell)
    }
    const colours = new Uint32Array(bytes.buffer), pixels = new Uint32Array(image.data.buffer)
    for (let row = 0, i = 0; row < height; row++) {
      for (let at = (height - 1 - row) * width, end = at + width; at < end; at++, i++) pixels[at] = colours[cells[i] & 255]
    }
    pen.putImageData(image, 0, 0)
  }

  #paint() {
    const ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = this.canvas
    if (this.canvas.width !== Math.round(w * ratio) || this.canvas.height !== Math.round(h * ratio)) {
      this.canvas.width = Math.round(w * ratio)
      this.canvas.height = Math.round(h * ratio)
    }
    const pen = this.canvas.getContext('2d')
    pen.setTransform(1, 0, 0, 1, 0, 0)
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height)
    const k = this.#scale * ratio
    pen.setTransform(k, 0, 0, -k, (w * ratio) / 2 - this.#centre[0] * k, (h * ratio) / 2 + this.#centre[1] * k)
    this.pixel = 1 / this.#scale
    this.#paintGrid(pen, w, h)
    this.#paintSurroundings(pen)
    for (const paint of this.layers) paint(pen)
    const pose = this.robot?.pose
    if (pose) {
      pen.save()
      pen.translate(pose.x, pose.y)
      pen.rotate(pose.yaw)
      for (const paint of [...this.robotLayers, ...ON_ROBOT]) paint(pen, this)
      pen.restore()
    }
    this.#paintPath(pen)
    this.#paintGoal(pen)
  }

  #paintPath(pen) {
    const path = this.task?.path ?? []
    pen.beginPath()
    path.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)))
    pen.setLineDash([8 * this.pixel, 6 * this.pixel])
    this.stroke(pen, this.colour.plan, 2)
    pen.setLineDash([])
  }

  #paintGrid(pen, w, h) {
    const [cx, cy] = this.#centre, half = [w / 2 / this.#scale, h / 2 / this.#scale]
    const step = this.#scale > 25 ? 1 : 5
    pen.beginPath()
    for (let x = Math.ceil((cx - half[0]) / step) * step; x < cx + half[0]; x += step) { pen.moveTo(x, cy - half[1]); pen.lineTo(x, cy + half[1]) }
    for (let y = Math.ceil((cy - half[1]) / step) * step; y < cy + half[1]; y += step) { pen.moveTo(cx - half[0], y); pen.lineTo(cx + half[0], y) }
    this.stroke(pen, this.colour.grid, 1)
  }

  #paintSurroundings(pen) {
    pen.imageSmoothingEnabled = false
    const drawCells = (picture, x, y, cell) => {
      pen.save()
      pen.translate(x, y)
      pen.scale(cell, -cell)
      pen.drawImage(picture, 0, -picture.height)
      pen.restore()
    }
    if (this.map) drawCells(this.picture, this.map.x, this.map.y, this.map.resolution)
    else drawCells(this.trace, (-TRACE_CELLS / 2) * TRACE_CELL_M, (-TRACE_CELLS / 2) * TRACE_CELL_M, TRACE_CELL_M)
    pen.beginPath()
    this.trail.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)))
    this.stroke(pen, this.colour.trail, 2)
    pen.fillStyle = this.colour.scan
    const size = 3.5 * this.pixel
    for (const [x, y] of this.scan ?? []) pen.fillRect(x - size / 2, y - size / 2, size, size)
  }

  #paintGoal(pen) {
    const goal = this.#drag?.goal ?? this.goal
    if (!goal) return
    const size = 9 * this.pixel
    pen.beginPath()
    pen.arc(goal.x, goal.y, size, 0, TAU)
    if (goal.yaw != null) {
      pen.moveTo(goal.x, goal.y)
      pen.lineTo(goal.x + 3.5 * size * Math.cos(goal.yaw), goal.y + 3.5 * size * Math.sin(goal.yaw))
    }
    this.stroke(pen, this.colour.plan, 3)
  }

  stroke(pen, colour, pixels) {
    pen.strokeStyle = colour
    pen.lineWidth = pixels * this.pixel
    pen.stroke()
  }

  /** Write a text upright on the screen; `yaw` is the rotation of the current frame. */
  label(pen, text, x, y, yaw = 0) {
    pen.save()
    pen.translate(x, y)
    pen.rotate(-yaw)
    pen.scale(this.pixel, -this.pixel)
    pen.font = '12px system-ui, sans-serif'
    pen.textAlign = 'center'
    pen.lineWidth = 3
    pen.strokeStyle = this.colour.floor
    pen.strokeText(text, 0, 4)
    pen.fillStyle = this.colour.ink
    pen.fillText(text, 0, 4)
    pen.restore()
  }

  /** Return the place in the map under the pointer. */
  #placeOf(event) {
    const box = this.canvas.getBoundingClientRect()
    return [
      this.#centre[0] + (event.clientX - box.left - box.width / 2) / this.#scale,
      this.#centre[1] - (event.clientY - box.top - box.height / 2) / this.#scale,
    ]
  }

  #listen() {
    const canvas = this.canvas
    canvas.addEventListener('contextmenu', (event) => event.preventDefault())
    canvas.addEventListener('wheel', (event) => { event.preventDefault(); this.zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15) }, { passive: false })
    canvas.addEventListener('pointerdown', (event) => this.#down(event))
    canvas.addEventListener('pointermove', (event) => this.#move(event))
    canvas.addEventListener('pointerup', (event) => this.#up(event, true))
    canvas.addEventListener('pointercancel', (event) => this.#up(event, false))
  }

  #down(event) {
    this.canvas.setPointerCapture(event.pointerId)
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
    const moving = this.dragMoves || event.shiftKey || event.button > 0 || this.#pointers.size > 1
    const [x, y] = this.#placeOf(event)
    this.#drag = moving ? { last: [event.clientX, event.clientY] } : { goal: { x, y, yaw: null } }
    this.draw()
  }

  #move(event) {
    const before = this.#pointers.get(event.pointerId)
    if (!before || !this.#drag) return
    const now = [event.clientX, event.clientY], others = [...this.#pointers].filter(([id]) => id !== event.pointerId)
    if (others.length) {
      const distance = (p) => Math.hypot(p[0] - others[0][1][0], p[1] - others[0][1][1])
      this.zoom(distance(now) / Math.max(1, distance(before)))
    } else if (this.#drag.last) {
      this.#setFollow(false)
      this.#centre = [this.#centre[0] - (now[0] - before[0]) / this.#scale, this.#centre[1] + (now[1] - before[1]) / this.#scale]
    } else {
      const [x, y] = this.#placeOf(event), goal = this.#drag.goal
      const dx = x - goal.x, dy = y - goal.y
      goal.yaw = Math.hypot(dx, dy) > MIN_HEADING_DRAG_M ? Math.atan2(dy, dx) : null
    }
    this.#pointers.set(event.pointerId, now)
    this.draw()
  }

  #up(event, completed) {
    this.#pointers.delete(event.pointerId)
    const goal = this.#drag?.goal
    this.#drag = null
    if (goal && completed && (this.tool || goal.yaw !== null || !this.pick?.(goal))) (this.tool ?? this.onGoal)(goal)
    this.draw()
  }

  #setFollow(follow) {
    this.follow = follow
    document.getElementById('follow').setAttribute('aria-pressed', follow)
  }
}
