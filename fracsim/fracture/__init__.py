"""What breaks, and what that takes out of the stress."""
