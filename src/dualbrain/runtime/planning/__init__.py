"""Planning of one episode: the request, the local answers, the shots with their checks, replanning, and their times."""
