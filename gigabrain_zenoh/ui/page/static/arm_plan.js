// The plan of an arm as boxes to draw: beads along the path of its tool, and a pair of fingers for each grasp.
const PATH = [20, 90, 230], CHOSEN = [20, 140, 60], OTHER = [150, 150, 150]
const BEAD_M = 0.003, FINGER_M = [0.02, 0.004, 0.002] // half the lengths of each box
const LEVEL = [1, 0, 0, 0]

/** Transform a point from a frame to its parent, by the frame's rotation x, y, z, w and its position. */
function toParent([x, y, z, w], position, point) {
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
  const axis = [x, y, z], once = cross(axis, point).map((value, i) => value + w * point[i]), twice = cross(axis, once)
  return point.map((value, i) => position[i] + value + 2 * twice[i])
}

/** Return the boxes of a grasp: two fingers at the object, and the palm behind them. */
function hand({ position, orientation, opening }, colour) {
  const [x, y, z, w] = orientation, half = opening / 2 + FINGER_M[2], [long] = FINGER_M
  const box = (point, size) => ({ size, pose: [...toParent(orientation, position, point), w, x, y, z], colour })
  return [box([-long, 0, half], FINGER_M), box([-long, 0, -half], FINGER_M), box([-2 * long, 0, 0], [FINGER_M[2], FINGER_M[1], half])]
}

/** Return the boxes, each with half its size, its pose in the frame of the body, and its colour. */
export function planMarks({ path, grasps }) {
  const beads = path.map((point) => ({ size: [BEAD_M, BEAD_M, BEAD_M], pose: [...point, ...LEVEL], colour: PATH }))
  return [...beads, ...grasps.flatMap((grasp, i) => hand(grasp, i ? OTHER : CHOSEN))]
}
