/* Punctuality of the control thread with the simulated arm, beside busy processes; prints a line of JSON.
 *
 *   control_thread_run PERIODS PRIORITY BUSY       (PRIORITY 1 to 99: SCHED_FIFO; 0: ordinary scheduling)
 *
 * The main thread has ordinary priority. Every 10 ms it supplies a nominal control and a scene and reads the log.
 */
#define _GNU_SOURCE
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/utsname.h>
#include <time.h>

#include "busy_processes.h"
#include "dbk_clock.h"
#include "dbk_control_thread.h"
#include "drivers/dbk_simulated_arm.h"
#include "first_process.h"
#include "measurement.h"
#include "run_inputs.h"

#define MAX_PERIODS 1000000
#define INPUT_PAUSE_NS 10000000L
#define INPUTS_PER_CONTROL 50u /* a random nominal control is repeated for half a second */
#define MAX_CONTROL 0.5        /* [rad/s] */
#define N_SPHERES 12

typedef struct {
  int periods, priority, busy;
} run_options;

static dbk_control_loop loop;
static dbk_control_thread thread;
static dbk_simulated_arm arm;

static int parse_number(const char *text, int least, int most, int *to) {
  char *end;
  const long value = strtol(text, &end, 10);
  *to = (int)value;
  return *text != '\0' && *end == '\0' && value >= least && value <= most;
}

static int parse_options(int argc, char **argv, run_options *to) {
  return argc == 4 && parse_number(argv[1], 1, MAX_PERIODS, &to->periods) &&
         parse_number(argv[2], 0, 99, &to->priority) && parse_number(argv[3], 0, MAX_BUSY, &to->busy);
}

static void prepare_loop(void) {
  loop.tick.model = robot_model;
  loop.tick.hull_model = robot_hull_model;
  dbk_prepare(&loop.tick.model);
  dbk_prepare(&loop.tick.hull_model);
  loop.tick.limits = control_limits;
  dbk_control_loop_init(&loop, dbk_simulated_arm_init(&arm, robot_model.n, arm_home, arm_braking, arm_lag));
}

/* --- inputs ------------------------------------------------------------------------------------------------------ */

static void submit_scene(uint64_t number) {
  dbk_stamped_scene *slot = dbk_control_loop_scene_slot(&loop);
  dbk_scene_clear(&slot->scene);
  for (int32_t i = 0; i < N_SPHERES; ++i) {
    slot->scene.obstacle[i] = (dbk_obstacle){
        .shape = DBK_CAPSULE,
        .flags = DBK_STATIC,
        .rank = DBK_RANK_OBSTACLE,
        .link_mask = UINT32_MAX,
        .position = {0.6f, 0.1f * (float)i - 0.6f, 0.5f},
        .rotation = {1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f},
        .radius = 0.05f,
    };
  }
  slot->scene.n_obstacles = N_SPHERES;
  slot->stamp = (double)dbk_monotonic_us() / 1e6;
  slot->number = number;
  dbk_control_loop_submit_scene(&loop);
}

static void submit_control(uint64_t number) {
  static double u[DBK_MAX_DOF];
  for (int32_t k = 0; k < robot_model.n && number % INPUTS_PER_CONTROL == 1u; ++k) {
    u[k] = MAX_CONTROL * (2.0 * drand48() - 1.0);
  }
  (void)dbk_control_loop_submit_control(&loop, u, 0, number);
}

static void supply_until_complete(measurement *m) {
  const struct timespec pause = {0, INPUT_PAUSE_NS};
  for (uint64_t number = 2; !measurement_read(m, &loop, &thread); ++number) {
    submit_control(number);
    submit_scene(number);
    nanosleep(&pause, NULL);
  }
}

/* --- result ------------------------------------------------------------------------------------------------------ */

/* 1 if the kernel is PREEMPT_RT */
static int is_realtime_kernel(void) {
  FILE *file = fopen("/sys/kernel/realtime", "r");
  int value = 0;
  if (!file) { return 0; }
  if (fscanf(file, "%d", &value) != 1) { value = 0; }
  fclose(file);
  return value == 1;
}

static void print_kernel(void) {
  struct utsname name;
  uname(&name);
  printf("\n{\"kernel\":\"%s\",\"realtime\":%s", name.release, is_realtime_kernel() ? "true" : "false");
}

/* as the kernel reports them, not as they were requested */
static void print_scheduling(pthread_t of) {
  struct sched_param parameters = {0};
  int policy = -1;
  pthread_getschedparam(of, &policy, &parameters);
  printf(",\"policy\":\"%s\",\"priority\":%d", policy == SCHED_FIFO ? "SCHED_FIFO" : "SCHED_OTHER",
         parameters.sched_priority);
}

static void print_measurement(measurement *m, const run_options *options) {
  const uint32_t periods = measurement_elapsed(m, thread.period_us);
  measurement_sort(m);
  printf(",\"memory_locked\":%s,\"busy\":%d", thread.memory_lock != DBK_LOCK_NONE ? "true" : "false", options->busy);
  printf(",\"periods\":%u,\"ticks\":%u,\"missed\":%u,\"late\":%u", periods, m->ticks, periods - m->ticks, m->late);
  printf(",\"delay_median_us\":%u,\"delay_p999_us\":%u", measurement_quantile(m, 0.5), measurement_quantile(m, 0.999));
  printf(",\"delay_max_us\":%u,\"work_max_us\":%u", measurement_quantile(m, 1.0), m->max_work_us);
  printf(",\"moving\":%u,\"modified\":%u,\"dropped\":%llu}\n", m->moving, m->modified,
         (unsigned long long)loop.log.dropped);
}

static int run(const run_options *options) {
  busy_processes busy = {0};
  measurement m = {.periods = (uint32_t)options->periods};
  m.delay_us = (uint32_t *)calloc(m.periods, sizeof m.delay_us[0]);
  prepare_loop();
  submit_control(1);
  submit_scene(1);
  const int started = m.delay_us && busy_processes_start(&busy, options->busy) &&
                      !dbk_control_thread_start(&thread, &loop, (uint64_t)(control_limits.period * 1e6 + 0.5),
                                                options->priority, 1);
  if (started) {
    supply_until_complete(&m);
    print_kernel();
    print_scheduling(thread.thread);
    print_measurement(&m, options);
    dbk_control_thread_stop(&thread);
  }
  busy_processes_stop(&busy);
  free(m.delay_us);
  return started;
}

int main(int argc, char **argv) {
  run_options options;
  int done = 0;
  first_process_begin();
  if (!parse_options(argc, argv, &options)) {
    fputs("usage: control_thread_run PERIODS PRIORITY BUSY\n", stderr);
  } else if (!(done = run(&options))) {
    fputs("the run could not start: no memory, process or thread\n", stderr);
  }
  first_process_end();
  return done ? 0 : 1;
}
