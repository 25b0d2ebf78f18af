"""Skills of many control steps: pick and place, drag, drop into a container, move a joint."""
