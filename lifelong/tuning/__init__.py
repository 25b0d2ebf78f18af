"""The choice of settings by short streams of tasks: what a value keeps, what it lets learn, and which is best."""
