"""From a phone's pictures or video to a scene: frames are picked, cameras found, pictures undistorted, all reported."""
