"""Print the battery, and the hottest motor where the body measures it."""

import gigabrain_zenoh

READINGS = 3

with gigabrain_zenoh.connect() as robot:
    for count, state in enumerate(robot.topic("state", timeout=5), 1):
        if count % 50:  # fifty states a second
            continue
        if state.battery:
            print(f"{state.battery.percentage:.0f} %, {state.battery.voltage:.2f} V")
        temperatures = [one.temperature for one in state.joints if one.temperature is not None]
        if temperatures:
            print(f"hottest motor {max(temperatures):.0f} deg C")
        if count >= READINGS * 50:
            break
