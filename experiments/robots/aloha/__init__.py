"""The guard in front of the two arms of gym-aloha: identification of their servos, policies, judge, one episode."""
