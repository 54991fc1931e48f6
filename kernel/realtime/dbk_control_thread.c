/* The control thread; see dbk_control_thread.h. */
#define _GNU_SOURCE
#include "dbk_control_thread.h"

#include "dbk_clock.h"

#include <errno.h>
#include <sched.h>
#include <string.h>
#include <sys/mman.h>

#ifndef MCL_ONFAULT
#define MCL_ONFAULT 4
#endif

#define LATE_STATE_PERIODS 5u
#define TICKS_AHEAD 4u /* most ticks that states may pace before their time */
#define STACK_SIZE ((size_t)512 * 1024)

static uint64_t lateness(uint64_t due, uint64_t started) { return started > due ? started - due : 0u; }

/* statistics of a tick that was due at `due` and ran from `started` to `ended`; periods without a tick are skipped */
static uint64_t next_due(dbk_control_thread *t, uint64_t due, uint64_t started, uint64_t ended) {
  const uint64_t late = lateness(due, started), passed = ended > due ? (ended - due) / t->period_us : 0;
  if (late > t->late_limit_us) { __atomic_fetch_add(&t->late, 1u, __ATOMIC_RELAXED); }
  if (late > t->max_late_us) { t->max_late_us = (uint32_t)late; }
  if (ended - started > t->max_work_us) { t->max_work_us = (uint32_t)(ended - started); }
  __atomic_fetch_add(&t->skipped, passed, __ATOMIC_RELAXED);
  /* a state paces the next tick; without one the tick runs with the old state */
  if (t->loop->driver.wait) { return started + LATE_STATE_PERIODS * t->period_us; }
  return due + (passed + 1u) * t->period_us;
}

/* Waits until a tick that a state paces is at most TICKS_AHEAD periods before its time; returns the time. Every tick may
 * change the control by one period's acceleration, so a robot that sends states faster than its period would be
 * accelerated beyond its limit. The clocks may differ by 1/64. */
static uint64_t wait_for_turn(dbk_control_thread *t) {
  const uint64_t ahead = (uint64_t)TICKS_AHEAD * t->period_us;
  uint64_t now = dbk_monotonic_us();
  if (t->turn_us > now + ahead) {
    dbk_sleep_until(t->turn_us - ahead);
    now = dbk_monotonic_us();
  }
  t->turn_us = (t->turn_us > now ? t->turn_us : now) + t->period_us - t->period_us / 64u;
  return now;
}

static void *run(void *argument) {
  dbk_control_thread *t = (dbk_control_thread *)argument;
  const dbk_driver *driver = &t->loop->driver;
  uint64_t due = dbk_monotonic_us() + t->period_us;
  uint32_t work = 0;
  while (!__atomic_load_n(&t->loop->finished, __ATOMIC_ACQUIRE)) {
    if (driver->wait) {
      driver->wait(driver->self, due);
    } else {
      dbk_sleep_until(due);
    }
    const uint64_t started = driver->wait ? wait_for_turn(t) : dbk_monotonic_us();
    const uint64_t now = driver->clock ? driver->clock(driver->self, started) : started;
    dbk_control_loop_tick(t->loop, now, (uint32_t)lateness(due, started), work);
    const uint64_t ended = dbk_monotonic_us();
    __atomic_store_n(&t->last_tick_us, started, __ATOMIC_RELEASE);
    work = (uint32_t)(ended - started);
    due = next_due(t, due, started, ended);
  }
  return NULL;
}

/* locks the memory that the thread uses, and touches the stack, so that no tick waits for a page */
static void lock_memory(dbk_control_thread *t, int process) {
  memset(t->stack, 0, STACK_SIZE);
  t->lock_error = 0;
  if (process) {
    if (mlockall(MCL_CURRENT | MCL_ONFAULT) == 0) {
      t->memory_lock = DBK_LOCK_PROCESS;
      return;
    }
    t->lock_error = errno;
  }
  if (mlock(t->loop, sizeof *t->loop) == 0 && mlock(t->stack, STACK_SIZE) == 0) {
    t->memory_lock = DBK_LOCK_LOOP;
  } else {
    t->lock_error = errno;
  }
}

static int create(dbk_control_thread *t, int32_t priority) {
  pthread_attr_t attributes;
  const struct sched_param parameters = {.sched_priority = priority};
  pthread_attr_init(&attributes);
  int error = pthread_attr_setstack(&attributes, t->stack, STACK_SIZE);
  if (!error && priority > 0) {
    error = pthread_attr_setinheritsched(&attributes, PTHREAD_EXPLICIT_SCHED);
    if (!error) { error = pthread_attr_setschedpolicy(&attributes, SCHED_FIFO); }
    if (!error) { error = pthread_attr_setschedparam(&attributes, &parameters); }
  }
  if (!error) { error = pthread_create(&t->thread, &attributes, run, t); }
  pthread_attr_destroy(&attributes);
  return error;
}

int dbk_control_thread_start(dbk_control_thread *t, dbk_control_loop *loop, uint64_t period_us, int32_t priority,
                             int lock_process) {
  memset(t, 0, sizeof *t);
  t->loop = loop;
  t->period_us = period_us;
  t->priority = priority;
  t->late_limit_us = 200u;
  t->stack = mmap(NULL, STACK_SIZE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (t->stack == MAP_FAILED) { return errno; }
  lock_memory(t, lock_process);
  int error = create(t, priority);
  t->fifo = !error && priority > 0;
  if (error && priority > 0) {
    t->fifo_error = error;
    error = create(t, 0);
  }
  t->running = !error;
  if (error) { munmap(t->stack, STACK_SIZE); }
  return error;
}

void dbk_control_thread_stop(dbk_control_thread *t) {
  if (!t->running) { return; }
  dbk_control_loop_request_stop(t->loop);
  pthread_join(t->thread, NULL);
  munmap(t->stack, STACK_SIZE);
  (void)munlock(t->loop, sizeof *t->loop);
  t->running = 0;
}
