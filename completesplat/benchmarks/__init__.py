"""What takes how long, side by side in one process. Nothing else imports this package."""
