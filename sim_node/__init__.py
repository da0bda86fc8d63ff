"""The world: physics, bodies and sensors. Only this room imports PyBullet."""
