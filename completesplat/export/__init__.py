"""Files that a person opens: splats, videos, contact sheets, scene descriptions."""
