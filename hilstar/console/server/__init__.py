"""The page's own process: reads what a run leaves on its board, and serves it to browsers and monitoring, without OpenGL."""
