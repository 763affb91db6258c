"""The table at the end of a sweep: ablations over seeds, as in the paper."""
