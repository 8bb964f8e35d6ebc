"""Questions of the map: what a person asks it, pure over the map after W events."""
