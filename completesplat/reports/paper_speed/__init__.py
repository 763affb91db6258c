"""The paper's figures of speed (one A100), beside what they are here."""
