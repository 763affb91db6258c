"""Our scores beside the published ones, and in tables of their own where they were measured otherwise."""
