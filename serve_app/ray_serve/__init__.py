"""Ray Serve integration: deployment, ingress, HAProxy, cluster processes, autoscaling."""
