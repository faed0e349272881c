"""Static web page of a bundle: its policy, its robot where it is one of ours, its card and its proof, in a browser."""
