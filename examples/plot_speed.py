"""Drive to and fro, and plot commanded and measured speed as speed.png."""

import math

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import gigabrain_zenoh

SECONDS, HZ = 6, 50

states = []
with gigabrain_zenoh.connect(take=True) as robot:
    for count, state in enumerate(robot.topic("state", timeout=5)):
        if count >= SECONDS * HZ:
            break
        states.append(state)
        if count % 5 == 0:  # ten commands a second
            robot.set_base_velocity(0.15 * math.sin(math.tau * count / HZ / 3))

time_s = [(state.tick - states[0].tick) / HZ for state in states]
plt.plot(time_s, [state.sent.linear_x for state in states], label="commanded")
plt.plot(time_s, [state.velocity.linear_x for state in states], label="measured")
plt.xlabel("time [s]")
plt.ylabel("linear_x [m/s]")
plt.legend()
plt.savefig("speed.png")
print(f"speed.png: at most {max(state.velocity.linear_x for state in states):.2f} m/s")
