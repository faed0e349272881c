"""RLlib adapters: restore a checkpoint of either API stack and run it as RLlib does."""
