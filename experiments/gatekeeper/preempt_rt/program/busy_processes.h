/* Load: child processes with ordinary priority that compute and write to a file in memory without a pause. */
#ifndef BUSY_PROCESSES_H
#define BUSY_PROCESSES_H

#define MAX_BUSY 64

typedef struct {
  int count, process[MAX_BUSY];
} busy_processes;

/* 1 if all `count` processes run; they end with the process that starts them */
int busy_processes_start(busy_processes *b, int count);

void busy_processes_stop(const busy_processes *b);

#endif
