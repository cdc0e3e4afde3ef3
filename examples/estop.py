"""Press the e-stop, look at what it did, then release the robot and let its brain drive."""

import gigabrain_zenoh

with gigabrain_zenoh.connect() as robot:
    pressed = robot.estop("an example")  # returns once the gate is at zero and latched
    print(pressed.gate.mode, pressed.gate.estop_generation)
    try:
        robot.enable("control")
    except gigabrain_zenoh.Refused as error:
        print(f"refused: {error}")  # a latched robot must be released first
    print(robot.release().gate.mode)
    print(robot.enable("control").gate.mode)  # `control` is the robot's own brain
