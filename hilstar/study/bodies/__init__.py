"""What each body costs and how exact it is: time a frame, light and limb against size, and where its model fails."""
