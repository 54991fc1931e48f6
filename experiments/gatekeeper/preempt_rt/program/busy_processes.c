/* Load of the processor; see busy_processes.h. */
#define _GNU_SOURCE
#include "busy_processes.h"

#include <signal.h>
#include <stdint.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#define BLOCK ((size_t)64 * 1024)

static void work_for_ever(void) {
  static uint8_t block[BLOCK];
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  const int file = memfd_create("load", 0);
  for (;;) {
    for (size_t i = 0; i < BLOCK; ++i) { block[i] = (uint8_t)(5u * block[i] + 1u); }
    if (pwrite(file, block, BLOCK, 0) < 0) { _exit(1); }
  }
}

int busy_processes_start(busy_processes *b, int count) {
  for (b->count = 0; b->count < count; ++b->count) {
    const int process = fork();
    if (process == 0) { work_for_ever(); }
    if (process < 0) { return 0; }
    b->process[b->count] = process;
  }
  return 1;
}

void busy_processes_stop(const busy_processes *b) {
  for (int i = 0; i < b->count; ++i) {
    kill(b->process[i], SIGKILL);
    waitpid(b->process[i], NULL, 0);
  }
}
