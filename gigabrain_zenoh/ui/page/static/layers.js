// Layers drawn in the robot's frame. Each function takes the canvas context and the map view.
const TAU = 2 * Math.PI
const AHEAD_S = 1, SLOW = 0.05 // how far ahead of a moving thing its line reaches; below [m/s] there is none
const LARGE = 0.3, GAP = 0.25 // [m] radius of what is drawn as it was seen; between beams on one thing

/** Free space up to the nearest obstacle in each sector. */
function paintFree(pen, view) {
  const sectors = view.moment.world?.sectors ?? []
  pen.beginPath()
  sectors.forEach((distance, i) => {
    if (distance === null) return
    const middle = (i * TAU) / sectors.length, half = (0.42 * TAU) / sectors.length
    pen.moveTo(distance * Math.cos(middle - half), distance * Math.sin(middle - half))
    pen.arc(0, 0, distance, middle - half, middle + half)
  })
  pen.globalAlpha = 0.5
  view.stroke(pen, view.colour.zone, 1.5)
  pen.globalAlpha = 1
}

/** What must be free for the body to stop at its present speed. */
function paintZones(pen, view) {
  const { body, moment: { state } } = view
  if (!body || !state) return
  const v = state.velocity.linear_x, t = body.thresholds
  const reach = Math.abs(v) * t.reaction_time + (v * v) / (2 * body.max_linear_deceleration) + t.stop_margin
  const xs = body.footprint.map((p) => p[0]), ys = body.footprint.map((p) => p[1])
  const left = Math.max(...ys), right = Math.min(...ys)
  pen.globalAlpha = 0.45
  pen.fillStyle = view.colour.zone
  if (v >= 0) pen.fillRect(Math.max(...xs), right, reach, left - right)
  else pen.fillRect(Math.min(...xs) - reach, right, reach, left - right)
  pen.globalAlpha = 1
}

function paintPlan(pen, view) {
  const points = view.moment.intent?.trajectory ?? []
  pen.beginPath()
  pen.moveTo(0, 0)
  for (const [, x, y] of points) pen.lineTo(x, y)
  view.stroke(pen, view.colour.plan, 3)
}

function paintRobot(pen, view) {
  const outline = view.body?.footprint ?? []
  pen.beginPath()
  outline.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)))
  pen.closePath()
  pen.fillStyle = view.colour.robot
  pen.fill()
  view.stroke(pen, view.colour.ink, 2)
  const size = Math.max(0.07, 7 * view.pixel)
  pen.beginPath()
  pen.moveTo(size, 0)
  pen.lineTo(-size * 0.7, size * 0.7)
  pen.lineTo(-size * 0.7, -size * 0.7)
  pen.fillStyle = view.colour.plan
  pen.fill()
}

/** Points as seen from a pose. */
const from = ({ x, y, yaw }) => {
  const c = Math.cos(yaw), s = Math.sin(yaw)
  return ([px, py]) => [c * (px - x) + s * (py - y), c * (py - y) - s * (px - x)]
}

/** What perception follows from scan to scan; it is told in the frame of the odometry.

What is large and stands, such as a wall, is drawn as what was seen of it, and all else as a disc. */
function paintThings(pen, view) {
  const { world, state, pose } = view.moment
  if (!state || !pose) return
  const seen = (view.scan ?? []).map(from(pose)), here = from(state.pose), turned = from({ x: 0, y: 0, yaw: state.pose.yaw })
  for (const thing of world?.obstacles ?? []) {
    const [x, y] = here([thing.x, thing.y]), moves = Math.hypot(thing.velocity_x, thing.velocity_y) > SLOW
    const near = moves || thing.radius <= LARGE ? [] : seen.filter(([px, py]) => Math.hypot(px - x, py - y) < thing.radius + GAP)
    if (near.length) paintSeen(pen, view, near)
    else paintDisc(pen, view, x, y, thing.radius, moves ? turned([thing.velocity_x, thing.velocity_y]) : null)
  }
}

function paintSeen(pen, view, points) {
  pen.beginPath()
  points.forEach(([x, y], i) => {
    const joined = i && Math.hypot(x - points[i - 1][0], y - points[i - 1][1]) < GAP
    if (joined) pen.lineTo(x, y)
    else pen.moveTo(x, y)
  })
  pen.lineCap = pen.lineJoin = 'round'
  pen.globalAlpha = 0.45
  view.stroke(pen, view.colour.thing, 9)
  pen.globalAlpha = 1
}

function paintDisc(pen, view, x, y, radius, velocity) {
  pen.beginPath()
  pen.arc(x, y, Math.max(radius, 3 * view.pixel), 0, TAU)
  pen.globalAlpha = 0.35
  pen.fillStyle = view.colour.thing
  pen.fill()
  pen.globalAlpha = 1
  if (velocity) {
    pen.moveTo(x, y)
    pen.lineTo(x + AHEAD_S * velocity[0], y + AHEAD_S * velocity[1])
  }
  view.stroke(pen, view.colour.thing, 2)
}

export const ON_ROBOT = [paintFree, paintZones, paintThings, paintPlan, paintRobot]
