"""Policy versions of a server: the plan of aliases and canaries, loading, and the store that chooses one."""
