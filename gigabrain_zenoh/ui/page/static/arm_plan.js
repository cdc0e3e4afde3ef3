// The plan of an arm as boxes to draw: beads along the way of its tool, and a pair of fingers for each grasp.
const PATH = [20, 90, 230], CHOSEN = [20, 140, 60], OTHER = [150, 150, 150]
const BEAD_M = 0.003, FINGER_M = [0.02, 0.004, 0.002] // half the lengths of each box
const LEVEL = [1, 0, 0, 0]

/** Return where a point of a frame is, by its place and its rotation x, y, z, w. */
function placed([x, y, z, w], at, point) {
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
  const axis = [x, y, z], once = cross(axis, point).map((value, i) => value + w * point[i]), twice = cross(axis, once)
  return point.map((value, i) => at[i] + value + 2 * twice[i])
}

/** Return the boxes of a grasp: two fingers beside the thing, and the palm behind them. */
function hand({ position, orientation, opening }, colour) {
  const [x, y, z, w] = orientation, half = opening / 2 + FINGER_M[2], [long] = FINGER_M
  const box = (point, size) => ({ size, pose: [...placed(orientation, position, point), w, x, y, z], colour })
  return [box([-long, 0, half], FINGER_M), box([-long, 0, -half], FINGER_M), box([-2 * long, 0, 0], [FINGER_M[2], FINGER_M[1], half])]
}

/** Return half the size, the pose in the frame of the body and the colour of each box. */
export function planMarks({ path, grasps }) {
  const beads = path.map((point) => ({ size: [BEAD_M, BEAD_M, BEAD_M], pose: [...point, ...LEVEL], colour: PATH }))
  return [...beads, ...grasps.flatMap((grasp, i) => hand(grasp, i ? OTHER : CHOSEN))]
}
