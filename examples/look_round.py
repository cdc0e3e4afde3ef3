"""Turn once on the spot, and join the scans to one picture of points around the robot."""

import asyncio
import math

import numpy as np

import gigabrain_zenoh


async def main() -> None:
    async with gigabrain_zenoh.connect(take=True) as robot:
        body = await robot.read_body()
        mounting, points = np.array([body.lidar.x, body.lidar.y]), []

        async def collect() -> None:
            async for scan in robot.topic("scan", timeout=5):
                pose = robot.state.pose
                cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
                rotation = np.array([[cosine, -sine], [sine, cosine]])
                here = scan.points() + mounting  # in the body's frame
                points.append(here @ rotation.T + np.array([pose.x, pose.y]))

        collecting = asyncio.create_task(collect())
        turned = await robot.turn(math.tau)
        collecting.cancel()
        cloud = np.concatenate(points)
        np.save("points.npy", cloud)
        print(f"turned {math.degrees(turned.angle):.0f} deg, {len(cloud)} points in points.npy")


asyncio.run(main())
