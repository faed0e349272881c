"""Sources: the trainers whose policies are exported, behind one interface."""
