"""Policy versions of a server: repository, plan of aliases and canaries, and the store that acts."""
