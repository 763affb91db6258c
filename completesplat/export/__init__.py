"""Export of files for people: splats, videos, contact sheets and scene descriptions."""
