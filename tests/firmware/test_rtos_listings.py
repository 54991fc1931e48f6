"""The listings of the page about FreeRTOS and Zephyr compile, and define every function of the port header once.

The declarations below are those of the functions that the listings call; the sources of neither system are used.
"""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/how-to/guard/rtos_port.md").read_text("utf-8")
LISTINGS = dict(re.findall(r"## (FreeRTOS|Zephyr)\n.*?```c\n(.*?)```", PAGE, re.DOTALL))
FUNCTIONS = set(re.findall(r"\b(hal_\w+)\(", (ROOT / "firmware/port/hal.h").read_text("utf-8")))
FREERTOS = """
#include <stddef.h>
#include <stdint.h>
typedef long BaseType_t;
typedef unsigned long UBaseType_t;
typedef uint32_t TickType_t;
typedef void *TaskHandle_t, *StreamBufferHandle_t;
typedef void (*TaskFunction_t)(void *);
#define pdFALSE ((BaseType_t)0)
#define pdTRUE ((BaseType_t)1)
#define pdPASS pdTRUE
#define configTICK_RATE_HZ 1000
#define configMAX_PRIORITIES 8
#define pdMS_TO_TICKS(ms) ((TickType_t)(ms))
#define configASSERT(x) do { if (!(x)) { __builtin_trap(); } } while (0)
#define portYIELD_FROM_ISR(woken) (void)(woken)
TaskHandle_t xTaskGetCurrentTaskHandle(void);
TickType_t xTaskGetTickCount(void);
uint32_t ulTaskNotifyTake(BaseType_t clear, TickType_t ticks);
void vTaskNotifyGiveFromISR(TaskHandle_t task, BaseType_t *woken);
BaseType_t xTaskCreate(TaskFunction_t, const char *, uint32_t depth, void *, UBaseType_t, TaskHandle_t *);
StreamBufferHandle_t xStreamBufferCreate(size_t size, size_t trigger);
size_t xStreamBufferReceive(StreamBufferHandle_t, void *, size_t, TickType_t);
size_t xStreamBufferSendFromISR(StreamBufferHandle_t, const void *, size_t, BaseType_t *);
"""
ZEPHYR = """
#include <stddef.h>
#include <stdint.h>
struct device { int unused; };
extern const struct device any_device;
typedef struct { int64_t ticks; } k_timeout_t;
#define K_NO_WAIT ((k_timeout_t){0})
#define K_MSEC(ms) ((k_timeout_t){(ms)})
#define DEVICE_DT_GET(node) (&any_device)
struct gpio_dt_spec { const struct device *port; uint8_t pin; uint16_t dt_flags; };
#define GPIO_DT_SPEC_GET(node, property) {&any_device, 0, 0}
#define GPIO_INPUT (1u << 16)
#define GPIO_OUTPUT_INACTIVE (5u << 17)
int gpio_pin_configure_dt(const struct gpio_dt_spec *, uint32_t);
int gpio_pin_set_dt(const struct gpio_dt_spec *, int);
int gpio_pin_get_dt(const struct gpio_dt_spec *);
struct k_msgq { int unused; };
struct k_sem { int unused; };
#define K_MSGQ_DEFINE(name, size, count, align) struct k_msgq name
#define K_SEM_DEFINE(name, initial, limit) struct k_sem name
int k_msgq_put(struct k_msgq *, const void *, k_timeout_t);
int k_msgq_get(struct k_msgq *, void *, k_timeout_t);
void k_sem_give(struct k_sem *);
int k_sem_take(struct k_sem *, k_timeout_t);
int64_t k_uptime_ticks(void);
uint64_t k_ticks_to_us_floor64(uint64_t);
#define k_panic() __builtin_trap()
struct wdt_window { uint32_t min, max; };
typedef void (*wdt_callback_t)(const struct device *, int);
struct wdt_timeout_cfg { struct wdt_window window; wdt_callback_t callback; uint8_t flags; };
#define WDT_FLAG_RESET_SOC 2
int wdt_install_timeout(const struct device *, const struct wdt_timeout_cfg *);
int wdt_setup(const struct device *, uint8_t);
int wdt_feed(const struct device *, int);
typedef void (*uart_irq_callback_user_data_t)(const struct device *, void *);
int uart_irq_callback_user_data_set(const struct device *, uart_irq_callback_user_data_t, void *);
void uart_irq_rx_enable(const struct device *);
int uart_irq_update(const struct device *);
int uart_irq_rx_ready(const struct device *);
int uart_fifo_read(const struct device *, uint8_t *, int);
void uart_poll_out(const struct device *, unsigned char);
int sys_csrand_get(void *, size_t);
#define K_FP_REGS 2
#define K_HIGHEST_APPLICATION_THREAD_PRIO 0
typedef void (*k_thread_entry_t)(void *, void *, void *);
#define K_THREAD_DEFINE(name, stack, entry, a, b, c, priority, options, delay) const k_thread_entry_t name = entry
"""


@pytest.mark.parametrize(("system", "declarations"), [("FreeRTOS", FREERTOS), ("Zephyr", ZEPHYR)])
def test_a_listing_compiles_and_defines_the_functions_of_the_port(tmp_path, system, declarations):
    listing = LISTINGS[system]
    headers = re.findall(r'#include [<"]((?:FreeRTOS|stream_buffer|task|zephyr/[\w/]+)\.h)[>"]', listing)
    assert len(headers) >= 3
    for name in headers:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#pragma once\n{declarations}" if name == headers[0] else f'#include "{headers[0]}"\n')
    (tmp_path / "port.c").write_text(listing)
    folders = [f"-I{folder}" for folder in (tmp_path, ROOT / "firmware", ROOT / "kernel/include", ROOT / "kernel/src")]
    flags = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-DDBK_LANES=1", "-DDBK_MAX_OBSTACLES=48"]
    done = subprocess.run(
        ["gcc", *flags, *folders, str(tmp_path / "port.c")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert set(re.findall(r"^\S+ (hal_\w+)\(", listing, re.MULTILINE)) == FUNCTIONS
    assert "Neither was run" in PAGE
