// Stop a gigabrain robot when something comes near: a node in JavaScript, with rclnodejs.
//
//   npm install rclnodejs       (in a terminal where ROS 2 is sourced)
//   node stop.mjs [METRES] [--ros-args -r __ns:=/robot1]
//
// It reads `scan`, and calls `estop` once a beam is shorter. The robot then stays stopped until you
// call `release` and `enable`.
import rclnodejs from 'rclnodejs'

const near = Number(process.argv[2]) || 0.3 // [m]
await rclnodejs.init()
const node = rclnodejs.createNode('stop')
const estop = node.createClient('std_srvs/srv/SetBool', 'estop')
let scans = 0, asked = false

function look(scan) {
  // infinite is free and NaN is unknown: neither of them is near
  const hits = scan.ranges.filter((one) => one >= scan.range_min && one <= scan.range_max)
  const nearest = hits.reduce((a, b) => Math.min(a, b), Infinity)
  if (scans++ % 10 === 0) console.log(`${scan.ranges.length} beams, the nearest ${nearest.toFixed(2)} m`)
  if (nearest >= near || asked || !estop.isServiceServerAvailable()) return
  asked = true
  estop.sendRequest({ data: true }, ({ success, message }) => {
    console.log(`e-stop: ${message}`)
    rclnodejs.shutdown()
    process.exit(success ? 0 : 1)
  })
}

node.createSubscription('sensor_msgs/msg/LaserScan', 'scan', { qos: rclnodejs.QoS.profileSensorData }, look)
rclnodejs.spin(node)
