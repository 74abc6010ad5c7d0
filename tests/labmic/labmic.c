/* labmic: a capture device for ALSA in user space, for tests that must count samples.
 *
 * Sample n is taken at CLOCK_MONOTONIC = n / (rate * (1 + ppm * 1e-6)). Its value is n itself,
 * (n mod 65536) - 32768, or data[n mod length] of a raw s16 file, in which the samples of several
 * channels are interleaved. Loss, duplication, drift and outages can therefore be read off the
 * samples exactly. Without data, and beyond the channels of the data, all channels are the first. The ring overruns as a real one does:
 * a reader that is too slow gets -EPIPE.
 *
 *   gcc -O2 -fPIC -shared -DPIC -o libasound_module_pcm_labmic.so labmic.c -lasound
 *
 *   pcm_type.labmic { lib "/path/to/libasound_module_pcm_labmic.so" }
 *   pcm.labmic { type labmic  rate 16000  ctl "/path/to/control"  data "/path/to/samples.s16"
 *                channels 4  burst 32000 }
 *
 * Samples come in pieces of `burst` at once; by default as they are taken.
 *
 * The control file says "unplug" (the device is gone: -ENODEV), "busy" (another program has it: it
 * cannot be opened, -EBUSY) or "freeze" (it is there and delivers nothing); absent or empty means
 * normal. The environment variable LABMIC_PPM goes before
 * the field `ppm`.
 */
#include <alsa/asoundlib.h>
#include <alsa/pcm_external.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

/* A poll wakes the reader when a period is full, as a sound card does; one that has not read it
 * then, or is unplugged, so often in a period. */
#define TICKS_PER_PERIOD 4
#define LEAST_TICK 1000000LL /* nanoseconds */

enum condition { NORMAL, UNPLUGGED, BUSY, FROZEN };

struct settings {
    long rate;
    long channels; /* of the data */
    long burst;
    double ppm;
    const char *control;
    const char *data;
};

typedef struct {
    snd_pcm_ioplug_t io;
    double ppm;
    char *control;
    int16_t *data;
    long data_length; /* samples of a channel */
    long channels;    /* of the data */
    long burst;
    uint64_t first; /* index of the sample at position 0 of this start */
    int running;
} labmic_t;

/* Read at every call instead of watched: the test then knows that the next call sees the change. */
static enum condition condition_of(const labmic_t *mic)
{
    if (!mic->control)
        return NORMAL;
    int file = open(mic->control, O_RDONLY | O_CLOEXEC);
    if (file < 0)
        return NORMAL;
    char first = 0;
    ssize_t length = read(file, &first, 1);
    close(file);
    if (length != 1)
        return NORMAL;
    return first == 'u' ? UNPLUGGED : first == 'b' ? BUSY : first == 'f' ? FROZEN : NORMAL;
}

/* long double: after months of uptime a double no longer tells neighbouring samples apart
 * reliably once multiplied by the drift. */
static uint64_t index_now(const labmic_t *mic)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    long double seconds = now.tv_sec + now.tv_nsec * 1e-9L;
    return (uint64_t)(seconds * mic->io.rate * (1.0L + mic->ppm * 1e-6L));
}

static int16_t sample_at(const labmic_t *mic, uint64_t index, unsigned channel)
{
    if (mic->data)
        return mic->data[index % mic->data_length * mic->channels
                         + (channel < mic->channels ? channel : 0)];
    return (int16_t)((int)(index % 65536) - 32768);
}

static struct timespec duration_of(const snd_pcm_ioplug_t *io, snd_pcm_sframes_t frames)
{
    long long nanoseconds = 1000000000LL * frames / io->rate;
    if (nanoseconds < LEAST_TICK)
        nanoseconds = LEAST_TICK;
    return (struct timespec){nanoseconds / 1000000000, nanoseconds % 1000000000};
}

/* Wake the reader when so many more samples are there. */
static void set_tick(const snd_pcm_ioplug_t *io, snd_pcm_sframes_t missing)
{
    struct itimerspec tick = {.it_value = duration_of(io, missing),
                              .it_interval = duration_of(io, io->period_size / TICKS_PER_PERIOD)};
    timerfd_settime(io->poll_fd, 0, &tick, NULL);
}

static int mic_prepare(snd_pcm_ioplug_t *io)
{
    return condition_of(io->private_data) == UNPLUGGED ? -ENODEV : 0;
}

static int mic_start(snd_pcm_ioplug_t *io)
{
    labmic_t *mic = io->private_data;
    if (condition_of(mic) == UNPLUGGED)
        return -ENODEV;
    mic->first = index_now(mic);
    mic->running = 1;
    set_tick(io, io->period_size);
    return 0;
}

static int mic_stop(snd_pcm_ioplug_t *io)
{
    labmic_t *mic = io->private_data;
    mic->running = 0;
    timerfd_settime(io->poll_fd, 0, &(struct itimerspec){0}, NULL);
    return 0;
}

static snd_pcm_sframes_t mic_pointer(snd_pcm_ioplug_t *io)
{
    labmic_t *mic = io->private_data;
    enum condition condition = condition_of(mic);
    if (condition == UNPLUGGED) {
        snd_pcm_ioplug_set_state(io, SND_PCM_STATE_DISCONNECTED);
        return -ENODEV;
    }
    if (!mic->running)
        return 0;
    uint64_t taken = condition == FROZEN ? io->hw_ptr : index_now(mic) - mic->first;
    if (condition != FROZEN)
        taken -= taken % mic->burst;
    if (taken - io->appl_ptr >= io->buffer_size)
        return -EPIPE;
    return taken % io->buffer_size;
}

/* The samples are made when they are read: their values follow from their index alone. */
static snd_pcm_sframes_t mic_transfer(snd_pcm_ioplug_t *io, const snd_pcm_channel_area_t *areas,
                                      snd_pcm_uframes_t offset, snd_pcm_uframes_t size)
{
    const labmic_t *mic = io->private_data;
    for (snd_pcm_uframes_t i = 0; i < size; i++) {
        for (unsigned channel = 0; channel < io->channels; channel++) {
            int16_t value = sample_at(mic, mic->first + io->appl_ptr + i, channel);
            const snd_pcm_channel_area_t *area = &areas[channel];
            char *place = (char *)area->addr + (area->first + area->step * (offset + i)) / 8;
            memcpy(place, &value, sizeof value);
        }
    }
    return size;
}

static snd_pcm_sframes_t wanted_frames(snd_pcm_t *pcm)
{
    snd_pcm_uframes_t frames = 1;
    snd_pcm_sw_params_t *parameters;
    snd_pcm_sw_params_alloca(&parameters);
    if (snd_pcm_sw_params_current(pcm, parameters) == 0)
        snd_pcm_sw_params_get_avail_min(parameters, &frames);
    return frames;
}

static int mic_poll_revents(snd_pcm_ioplug_t *io, struct pollfd *descriptors, unsigned count,
                            unsigned short *events)
{
    (void)descriptors;
    (void)count;
    uint64_t ticks;
    ssize_t drained = read(io->poll_fd, &ticks, sizeof ticks); /* or the poll returns at once */
    (void)drained;
    if (condition_of(io->private_data) == UNPLUGGED) {
        snd_pcm_ioplug_set_state(io, SND_PCM_STATE_DISCONNECTED);
        *events = POLLERR | POLLNVAL;
        return 0;
    }
    snd_pcm_sframes_t available = snd_pcm_avail_update(io->pcm);
    snd_pcm_sframes_t wanted = wanted_frames(io->pcm);
    if (available < 0) {
        *events = POLLIN | POLLERR;
        return 0;
    }
    int is_full = available >= wanted;
    *events = is_full ? POLLIN : 0;
    set_tick(io, (is_full ? 2 * wanted : wanted) - available); /* a full one is read now */
    return 0;
}

static void mic_free(labmic_t *mic)
{
    if (mic->io.poll_fd >= 0)
        close(mic->io.poll_fd);
    free(mic->control);
    free(mic->data);
    free(mic);
}

static int mic_close(snd_pcm_ioplug_t *io)
{
    mic_free(io->private_data);
    return 0;
}

static const snd_pcm_ioplug_callback_t callbacks = {
    .start = mic_start,
    .stop = mic_stop,
    .prepare = mic_prepare,
    .pointer = mic_pointer,
    .transfer = mic_transfer,
    .poll_revents = mic_poll_revents,
    .close = mic_close,
};

static int read_settings(snd_config_t *configuration, struct settings *settings)
{
    snd_config_iterator_t place, next;
    snd_config_for_each(place, next, configuration) {
        snd_config_t *node = snd_config_iterator_entry(place);
        const char *id;
        if (snd_config_get_id(node, &id) < 0)
            continue;
        int error = 0;
        if (!strcmp(id, "rate"))
            error = snd_config_get_integer(node, &settings->rate);
        else if (!strcmp(id, "channels"))
            error = snd_config_get_integer(node, &settings->channels);
        else if (!strcmp(id, "burst"))
            error = snd_config_get_integer(node, &settings->burst);
        else if (!strcmp(id, "ppm"))
            error = snd_config_get_ireal(node, &settings->ppm);
        else if (!strcmp(id, "ctl"))
            error = snd_config_get_string(node, &settings->control);
        else if (!strcmp(id, "data"))
            error = snd_config_get_string(node, &settings->data);
        else if (strcmp(id, "comment") && strcmp(id, "type") && strcmp(id, "hint"))
            error = -EINVAL;
        if (error < 0) {
            SNDERR("labmic: unknown or wrong field %s", id);
            return error;
        }
    }
    if (settings->channels < 1 || settings->burst < 1)
        return -EINVAL;
    if (getenv("LABMIC_PPM"))
        settings->ppm = atof(getenv("LABMIC_PPM"));
    return 0;
}

static int load_data(labmic_t *mic, const char *path)
{
    FILE *file = fopen(path, "rb");
    if (!file)
        return -errno;
    fseek(file, 0, SEEK_END);
    long samples = ftell(file) / (long)sizeof *mic->data;
    rewind(file);
    mic->data = calloc(samples + 1, sizeof *mic->data);
    size_t length = mic->data ? fread(mic->data, sizeof *mic->data, samples, file) : 0;
    fclose(file);
    mic->data_length = samples / mic->channels;
    return mic->data_length > 0 && (long)length == samples ? 0 : -EINVAL;
}

static int limit(labmic_t *mic, long rate)
{
    static const unsigned access[] = {SND_PCM_ACCESS_RW_INTERLEAVED,
                                      SND_PCM_ACCESS_MMAP_INTERLEAVED};
    static const unsigned format[] = {SND_PCM_FORMAT_S16_LE};
    const struct { int parameter; unsigned minimum, maximum; } ranges[] = {
        {SND_PCM_IOPLUG_HW_CHANNELS, 1, mic->channels > 2 ? mic->channels : 2},
        {SND_PCM_IOPLUG_HW_PERIOD_BYTES, 64, 1 << 20},
        {SND_PCM_IOPLUG_HW_BUFFER_BYTES, 256, 4 << 20},
        {SND_PCM_IOPLUG_HW_PERIODS, 2, 1024},
    };
    snd_pcm_ioplug_t *io = &mic->io;
    int error = snd_pcm_ioplug_set_param_list(io, SND_PCM_IOPLUG_HW_ACCESS, 2, access);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_list(io, SND_PCM_IOPLUG_HW_FORMAT, 1, format);
    if (error >= 0)
        error = snd_pcm_ioplug_set_param_minmax(io, SND_PCM_IOPLUG_HW_RATE, rate, rate);
    for (size_t i = 0; error >= 0 && i < sizeof ranges / sizeof *ranges; i++)
        error = snd_pcm_ioplug_set_param_minmax(io, ranges[i].parameter, ranges[i].minimum,
                                                ranges[i].maximum);
    return error;
}

static labmic_t *new_mic(const struct settings *settings)
{
    labmic_t *mic = calloc(1, sizeof *mic);
    if (!mic)
        return NULL;
    mic->ppm = settings->ppm;
    mic->channels = settings->channels;
    mic->burst = settings->burst;
    mic->control = settings->control ? strdup(settings->control) : NULL;
    mic->io.version = SND_PCM_IOPLUG_VERSION;
    mic->io.name = "labmic";
    mic->io.callback = &callbacks;
    mic->io.private_data = mic;
    mic->io.poll_fd = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    mic->io.poll_events = POLLIN;
    mic->io.flags = SND_PCM_IOPLUG_FLAG_MONOTONIC; /* time stamps on the clock of the samples */
    return mic;
}

SND_PCM_PLUGIN_DEFINE_FUNC(labmic)
{
    (void)root;
    struct settings settings = {.rate = 16000, .channels = 1, .burst = 1};
    int error = read_settings(conf, &settings);
    if (error < 0)
        return error;
    if (stream != SND_PCM_STREAM_CAPTURE)
        return -EINVAL;
    labmic_t *mic = new_mic(&settings);
    if (!mic)
        return -ENOMEM;
    if (condition_of(mic) == UNPLUGGED)
        error = -ENODEV;
    else if (condition_of(mic) == BUSY)
        error = -EBUSY;
    else if (settings.data && (error = load_data(mic, settings.data)) < 0)
        SNDERR("labmic: cannot read samples from %s", settings.data);
    if (error >= 0)
        error = snd_pcm_ioplug_create(&mic->io, name, stream, mode);
    if (error < 0) {
        mic_free(mic);
        return error;
    }
    error = limit(mic, settings.rate);
    if (error < 0) {
        snd_pcm_ioplug_delete(&mic->io); /* closes, and so frees */
        return error;
    }
    *pcmp = mic->io.pcm;
    return 0;
}

SND_PCM_PLUGIN_SYMBOL(labmic);
