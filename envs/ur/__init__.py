"""Tasks of the Universal Robots arms."""
