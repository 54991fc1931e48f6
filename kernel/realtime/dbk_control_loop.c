/* The control loop without its clock; see dbk_control_loop.h. */
#include "dbk_control_loop.h"

#include <math.h>

#include "dbk/dbk_conditions.h"

#define MAX_PERMIT ((dbk_real)10) /* [m/s] largest permitted contact speed */

static void set_speed_bits(dbk_control_loop *l, double scale) {
  uint64_t bits;
  memcpy(&bits, &scale, sizeof bits);
  __atomic_store_n(&l->speed_scale_bits, bits, __ATOMIC_RELEASE);
}

void dbk_control_loop_init(dbk_control_loop *l, dbk_driver driver) {
  dbk_control_tick_init(&l->tick);
  l->driver = driver;
  dbk_latest_init(&l->controls);
  dbk_latest_init(&l->scenes);
  memset(l->control, 0, sizeof l->control);
  for (int32_t i = 0; i < 3; ++i) {
    l->scene[i].number = 0;
    l->scene[i].stamp = 0.0;
    dbk_scene_clear(&l->scene[i].scene);
    l->scene[i].scene.ready = 0;
  }
  l->held_conditions = l->pressed_conditions = l->refused = l->refused_seen = 0;
  l->stop_requested = l->drive_off = l->finished = 0;
  l->called = l->has_called = 0;
  l->ticks = l->control_us = l->called_us = l->stop_us = l->own_conditions = 0;
  set_speed_bits(l, 1.0);
  dbk_ring_init(&l->log, l->record, DBK_LOG_CAPACITY, (uint32_t)sizeof l->record[0]);
}

/* --- the other thread ------------------------------------------------------------------------------------------- */

int dbk_control_loop_submit_control(dbk_control_loop *l, const double *u, int standstill, uint64_t number) {
  dbk_nominal_control *slot = &l->control[l->controls.writing];
  for (int32_t k = 0; k < l->tick.model.n; ++k) {
    if (!isfinite(u[k])) {
      __atomic_fetch_add(&l->refused, 1u, __ATOMIC_RELAXED);
      return 0;
    }
    slot->u[k] = u[k];
  }
  slot->number = number;
  slot->standstill = standstill;
  dbk_latest_publish(&l->controls);
  return 1;
}

dbk_stamped_scene *dbk_control_loop_scene_slot(dbk_control_loop *l) { return &l->scene[l->scenes.writing]; }

void dbk_control_loop_submit_scene(dbk_control_loop *l) { dbk_latest_publish(&l->scenes); }

void dbk_control_loop_call(dbk_control_loop *l) { __atomic_store_n(&l->called, 1u, __ATOMIC_RELEASE); }

uint64_t dbk_control_loop_take_conditions(dbk_control_loop *l) {
  return __atomic_exchange_n(&l->own_conditions, 0u, __ATOMIC_ACQ_REL);
}

void dbk_control_loop_hold(dbk_control_loop *l, uint64_t conditions, int held) {
  if (held) {
    __atomic_fetch_or(&l->held_conditions, conditions, __ATOMIC_ACQ_REL);
  } else {
    __atomic_fetch_and(&l->held_conditions, ~conditions, __ATOMIC_ACQ_REL);
  }
}

void dbk_control_loop_press(dbk_control_loop *l, uint64_t buttons) {
  __atomic_fetch_or(&l->pressed_conditions, buttons & DBK_CONDITION_BUTTONS, __ATOMIC_ACQ_REL);
}

int dbk_control_loop_set_speed(dbk_control_loop *l, double scale) {
  if (!(scale > 0.0 && scale <= 1.0)) { return 0; }
  set_speed_bits(l, scale);
  return 1;
}

void dbk_control_loop_set_drive(dbk_control_loop *l, int on) {
  __atomic_store_n(&l->drive_off, (uint32_t)!on, __ATOMIC_RELEASE);
}

void dbk_control_loop_request_stop(dbk_control_loop *l) { __atomic_store_n(&l->stop_requested, 1u, __ATOMIC_RELEASE); }

/* --- the loop --------------------------------------------------------------------------------------------------- */

static void check_permits(dbk_scene *scene, int32_t n_links) {
  for (int32_t o = 0; o < DBK_PADDED(scene->n_obstacles); ++o) {
    for (int32_t link = 0; link <= n_links; ++link) {
      const dbk_real speed = scene->permit[link][o];
      if (!(speed <= MAX_PERMIT && o < scene->n_obstacles)) { scene->permit[link][o] = (dbk_real)-1; }
    }
  }
}

/* takes a new scene and checks it again; a scene that is not valid is unusable, and the arm brakes */
static void take_scene(dbk_control_loop *l) {
  if (!dbk_latest_take(&l->scenes)) { return; }
  dbk_stamped_scene *scene = &l->scene[l->scenes.reading];
  dbk_scene_prepare(&scene->scene);
  if (!isfinite(scene->stamp)) { scene->scene.ready = 0; }
  if (scene->scene.ready) { check_permits(&scene->scene, l->tick.model.n_links); }
}

/* the nominal control in force; zero and a condition if it is late */
static uint64_t take_control(dbk_control_loop *l, dbk_tick_record *record) {
  if (dbk_latest_take(&l->controls)) { l->control_us = record->now_us; }
  const dbk_nominal_control *control = &l->control[l->controls.reading];
  const double age = (double)(record->now_us - l->control_us) / 1e6;
  const int late = control->number == 0 || !(age <= l->tick.limits.control_valid);
  record->control_number = control->number;
  record->standstill = control->standstill;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { record->u_nom[k] = late ? 0.0 : control->u[k]; }
  return late ? DBK_CONDITION_HEARTBEAT_LOST : (uint64_t)0;
}

/* conditions from outside the tick */
static uint64_t external_conditions(dbk_control_loop *l, const dbk_tick_record *record) {
  const dbk_stamped_scene *scene = &l->scene[l->scenes.reading];
  uint64_t flags = __atomic_exchange_n(&l->pressed_conditions, 0u, __ATOMIC_ACQ_REL);
  flags |= __atomic_load_n(&l->held_conditions, __ATOMIC_ACQUIRE); /* after the buttons: a release precedes its reset */
  if (__atomic_exchange_n(&l->called, 0u, __ATOMIC_ACQ_REL)) {
    l->has_called = 1;
    l->called_us = record->now_us;
  }
  if (!l->tick.has_state) { l->called_us = record->now_us; } /* the robot's clock begins with its first state */
  const double since = l->has_called ? (double)(record->now_us - l->called_us) / 1e6 : 0.0;
  if (since > l->tick.limits.caller_lost_after) { flags |= DBK_CONDITION_TICK_LOST; }
  const uint64_t refused = __atomic_load_n(&l->refused, __ATOMIC_RELAXED);
  if (refused != l->refused_seen) { flags |= DBK_CONDITION_FRAMES_REFUSED; }
  l->refused_seen = refused;
  const double scene_age = (double)record->now_us / 1e6 - scene->stamp;
  if (scene->scene.moving && !(scene_age <= l->tick.limits.scene_old_after)) { flags |= DBK_CONDITION_SCENE_OLD; }
  if (__atomic_load_n(&l->stop_requested, __ATOMIC_ACQUIRE)) { flags |= DBK_CONDITION_INTERRUPT; }
  return flags;
}

/* 1 after a request to stop if the drive is off, or goes off now because the time is up */
static int stop_ends(dbk_control_loop *l, dbk_tick_record *record) {
  if (!__atomic_load_n(&l->stop_requested, __ATOMIC_ACQUIRE)) { return 0; }
  if (l->stop_us == 0) { l->stop_us = record->now_us; }
  if (record->now_us - l->stop_us >= DBK_STOP_LIMIT_US) {
    record->drive_enable = 0;
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { record->u[k] = 0.0; }
  }
  return !record->drive_enable;
}

static void write_command(dbk_control_loop *l, const dbk_tick_record *record) {
  dbk_joint_command command = {.tick = record->tick, .now_us = record->now_us, .drive_enable = record->drive_enable};
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { command.u[k] = record->u[k]; }
  l->driver.write(l->driver.self, record->now_us, &command);
}

void dbk_control_loop_tick(dbk_control_loop *l, uint64_t now_us, uint32_t wake_late_us, uint32_t last_work_us) {
  dbk_tick_record record = {0};
  uint64_t bits = __atomic_load_n(&l->speed_scale_bits, __ATOMIC_ACQUIRE);
  record.tick = ++l->ticks;
  record.now_us = now_us;
  record.wake_late_us = wake_late_us;
  record.work_us = last_work_us;
  memcpy(&record.speed_scale, &bits, sizeof bits);
  record.drive_off = (int32_t)__atomic_load_n(&l->drive_off, __ATOMIC_ACQUIRE);
  record.new_state = l->driver.read(l->driver.self, now_us, &record.state);
  take_scene(l);
  record.external = take_control(l, &record);
  record.external |= external_conditions(l, &record);
  const dbk_stamped_scene *scene = &l->scene[l->scenes.reading];
  record.scene_number = scene->number;
  record.check = (int32_t)DBK_NO_CHECK;
  const int has_result = dbk_control_tick_run(&l->tick, scene, &record), ends = stop_ends(l, &record);
  /* first the log: its reader knows the cause of a command before the effect */
  __atomic_fetch_or(&l->own_conditions, record.conditions & ~record.external, __ATOMIC_ACQ_REL);
  (void)dbk_ring_push(&l->log, &record);
  if (has_result) { write_command(l, &record); }
  if (ends) { __atomic_store_n(&l->finished, 1u, __ATOMIC_RELEASE); }
}
