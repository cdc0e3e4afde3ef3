// Layers drawn in the robot's frame. Each function takes the canvas context and the map view.
const TAU = 2 * Math.PI
const LINE_TIME_S = 1 // the line of a moving obstacle ends at its predicted place after this time
const MIN_SPEED = 0.05 // [m/s], slower obstacles have no line
const MIN_WALL_RADIUS_M = 0.3 // larger obstacles at rest are drawn as their scan points
const MAX_POINT_GAP_M = 0.25 // between two neighbouring points of one obstacle

/** Paint the distance to the nearest obstacle in each sector. */
function paintSectors(pen, view) {
  const sectors = view.robot.world?.sectors ?? []
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

/** Paint the zone that must be free for the body to stop from its present speed. */
function paintStopZone(pen, view) {
  const { body, robot: { state } } = view
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
  const points = view.robot.intent?.trajectory ?? []
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

/** Return a function that transforms a point into the frame of a pose. */
export const toFrameOf = ({ x, y, yaw }) => {
  const c = Math.cos(yaw), s = Math.sin(yaw)
  return ([px, py]) => [c * (px - x) + s * (py - y), c * (py - y) - s * (px - x)]
}

/** Paint the obstacles that perception tracks, which are in the odometry frame.

Large ones at rest, such as walls, are drawn as their scan points, all others as discs. */
function paintObstacles(pen, view) {
  const { world, state, pose } = view.robot
  if (!state || !pose) return
  const points = (view.scan ?? []).map(toFrameOf(pose))
  const toRobot = toFrameOf(state.pose), rotate = toFrameOf({ x: 0, y: 0, yaw: state.pose.yaw })
  for (const obstacle of world?.obstacles ?? []) {
    const velocity = [obstacle.velocity_x, obstacle.velocity_y], moves = Math.hypot(...velocity) > MIN_SPEED
    const [x, y] = toRobot([obstacle.x, obstacle.y]), reach = obstacle.radius + MAX_POINT_GAP_M
    const isWall = !moves && obstacle.radius > MIN_WALL_RADIUS_M
    const near = isWall ? points.filter(([px, py]) => Math.hypot(px - x, py - y) < reach) : []
    if (near.length) paintPoints(pen, view, near)
    else paintDisc(pen, view, x, y, obstacle.radius, moves ? rotate(velocity) : null)
  }
}

function paintPoints(pen, view, points) {
  pen.beginPath()
  points.forEach(([x, y], i) => {
    const joined = i && Math.hypot(x - points[i - 1][0], y - points[i - 1][1]) < MAX_POINT_GAP_M
    if (joined) pen.lineTo(x, y)
    else pen.moveTo(x, y)
  })
  pen.lineCap = pen.lineJoin = 'round'
  pen.globalAlpha = 0.45
  view.stroke(pen, view.colour.obstacle, 9)
  pen.globalAlpha = 1
}

export function paintDisc(pen, view, x, y, radius, velocity) {
  pen.beginPath()
  pen.arc(x, y, Math.max(radius, 3 * view.pixel), 0, TAU)
  pen.globalAlpha = 0.35
  pen.fillStyle = view.colour.obstacle
  pen.fill()
  pen.globalAlpha = 1
  if (velocity) {
    pen.moveTo(x, y)
    pen.lineTo(x + LINE_TIME_S * velocity[0], y + LINE_TIME_S * velocity[1])
  }
  view.stroke(pen, view.colour.obstacle, 2)
}

export const ON_ROBOT = [paintSectors, paintStopZone, paintObstacles, paintPlan, paintRobot]
