"""From proprioceptive sensors to markers to bones: the networks of the XR paper, and better ones."""
