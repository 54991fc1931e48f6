/* A POSIX thread that ticks a control loop at absolute times, with real-time priority and locked memory where permitted.
 *
 * The priority and the lock are best effort: the result names the permissions that were granted, and the errors of the others.
 */
#ifndef DBK_CONTROL_THREAD_H
#define DBK_CONTROL_THREAD_H

#include <pthread.h>

#include "dbk_control_loop.h"

enum { DBK_LOCK_NONE, DBK_LOCK_LOOP, DBK_LOCK_PROCESS };

typedef struct {
  dbk_control_loop *loop;
  pthread_t thread;
  void *stack;
  uint64_t period_us;
  int32_t priority, running;
  /* granted permissions, and errno of a refused one (0: none was refused) */
  int32_t fifo, fifo_error, memory_lock, lock_error;
  /* written by the thread; turn_us: time of the next tick if no state comes too early */
  uint64_t turn_us, last_tick_us, skipped, late, late_limit_us;
  uint32_t max_late_us, max_work_us;
} dbk_control_thread;

/* Starts the thread. `priority` 1 to 99: SCHED_FIFO, or ordinary scheduling if it is refused; 0: ordinary. Returns errno,
 * 0 if the thread runs. `lock_process` locks all memory of the process, otherwise that of the loop and the stack. */
int dbk_control_thread_start(dbk_control_thread *t, dbk_control_loop *loop, uint64_t period_us, int32_t priority,
                             int lock_process);

/* requests a stop of the arm and waits until the drive is off and the thread has ended */
void dbk_control_thread_stop(dbk_control_thread *t);

#endif
