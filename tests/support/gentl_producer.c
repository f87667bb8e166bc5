/* A GenTL producer (GenICam GenTL 1.5, EMVA) of one synthetic camera, for tests of Harvesters: no
 * vendor's can be had without a camera. `gcc -shared -fPIC -pthread -o test.cti gentl_producer.c`.
 *
 * The camera has Width, Height, PixelFormat, ExposureTime, PayloadSize, AcquisitionStart and
 * AcquisitionStop. Image k (from 1) has the DN (x + 7 y + k) mod 4096 in Mono12 and Mono12Packed,
 * and its upper 8 bits in Mono8. GENTL_TEST_INCOMPLETE=N: its first N images are incomplete.
 */
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define API __attribute__((visibility("default"))) int32_t
enum { OK = 0, ERROR = -1001, NOT_IMPLEMENTED = -1003, INVALID_HANDLE = -1006, INVALID_ID = -1007,
       TIMEOUT = -1011, NOT_AVAILABLE = -1014, INVALID_ADDRESS = -1015, TOO_SMALL = -1016,
       INVALID_INDEX = -1017 };
enum { STRING = 1, INT32 = 5, UINT32 = 6, UINT64 = 8, PTR = 10, BOOL8 = 11, SIZET = 12 };
enum { WIDTH = 64, HEIGHT = 48, PERIOD_MS = 20, MAX_BUFFERS = 64 };
enum { MONO8 = 0x01080001, MONO12 = 0x01100005, MONO12_PACKED = 0x010C0006 };
/* registers, little-endian: 8 bytes each */
enum { R_FORMAT = 0x1000, R_EXPOSURE = 0x1008, R_START = 0x1010, R_STOP = 0x1018,
       R_PAYLOAD = 0x1020, R_LOCKED = 0x1028, XML_AT = 0x10000 };

static const char XML[] =
"<?xml version=\"1.0\" encoding=\"utf-8\"?>"
"<RegisterDescription ModelName=\"Synthetic\" VendorName=\"Test\" StandardNameSpace=\"None\""
" SchemaMajorVersion=\"1\" SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\" MajorVersion=\"1\""
" MinorVersion=\"0\" SubMinorVersion=\"0\" ToolTip=\"\" ProductGuid=\"1F4C8C60-0000-4000-8000-000000000001\""
" VersionGuid=\"1F4C8C60-0000-4000-8000-000000000002\""
" xmlns=\"http://www.genicam.org/GenApi/Version_1_1\""
" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\""
" xsi:schemaLocation=\"http://www.genicam.org/GenApi/Version_1_1 GenApiSchema.xsd\">"
"<Category Name=\"Root\"><pFeature>Width</pFeature><pFeature>Height</pFeature>"
"<pFeature>PixelFormat</pFeature><pFeature>PayloadSize</pFeature><pFeature>ExposureTime</pFeature>"
"<pFeature>AcquisitionStart</pFeature><pFeature>AcquisitionStop</pFeature>"
"<pFeature>TLParamsLocked</pFeature></Category>"
"<Integer Name=\"Width\"><Value>64</Value></Integer>"
"<Integer Name=\"Height\"><Value>48</Value></Integer>"
"<Enumeration Name=\"PixelFormat\">"
"<EnumEntry Name=\"Mono8\"><Value>0x01080001</Value></EnumEntry>"
"<EnumEntry Name=\"Mono12\"><Value>0x01100005</Value></EnumEntry>"
"<EnumEntry Name=\"Mono12Packed\"><Value>0x010C0006</Value></EnumEntry>"
"<pValue>FormatReg</pValue></Enumeration>"
"<Integer Name=\"PayloadSize\"><pValue>PayloadReg</pValue></Integer>"
"<Float Name=\"ExposureTime\"><pValue>ExposureReg</pValue><Min>20.0</Min><Max>1000000.0</Max></Float>"
"<Command Name=\"AcquisitionStart\"><pValue>StartReg</pValue><CommandValue>1</CommandValue></Command>"
"<Command Name=\"AcquisitionStop\"><pValue>StopReg</pValue><CommandValue>1</CommandValue></Command>"
"<Integer Name=\"TLParamsLocked\"><pValue>LockedReg</pValue></Integer>"
#define INT_REG(name, at, access) \
"<IntReg Name=\"" name "\"><Address>" at "</Address><Length>8</Length><AccessMode>" access \
"</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable><Sign>Unsigned</Sign>" \
"<Endianess>LittleEndian</Endianess></IntReg>"
INT_REG("FormatReg", "0x1000", "RW")
"<FloatReg Name=\"ExposureReg\"><Address>0x1008</Address><Length>8</Length>"
"<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
"<Endianess>LittleEndian</Endianess></FloatReg>"
INT_REG("StartReg", "0x1010", "RW") INT_REG("StopReg", "0x1018", "RW")
INT_REG("PayloadReg", "0x1020", "RO") INT_REG("LockedReg", "0x1028", "RW")
"<Port Name=\"Device\"></Port></RegisterDescription>";
/* the modules of this library have no features */
static const char EMPTY[] =
"<?xml version=\"1.0\" encoding=\"utf-8\"?>"
"<RegisterDescription ModelName=\"Module\" VendorName=\"Test\" StandardNameSpace=\"None\""
" SchemaMajorVersion=\"1\" SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\" MajorVersion=\"1\""
" MinorVersion=\"0\" SubMinorVersion=\"0\" ToolTip=\"\" ProductGuid=\"1F4C8C60-0000-4000-8000-000000000003\""
" VersionGuid=\"1F4C8C60-0000-4000-8000-000000000004\""
" xmlns=\"http://www.genicam.org/GenApi/Version_1_1\""
" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\""
" xsi:schemaLocation=\"http://www.genicam.org/GenApi/Version_1_1 GenApiSchema.xsd\">"
"<Category Name=\"Root\"></Category><Port Name=\"Port\"></Port></RegisterDescription>";

typedef struct { uint8_t *data; size_t size, filled; void *priv; int own, queued, incomplete;
                 uint64_t number, stamp_ns; } Buffer;
static int system_, interface_, device_, remote_, stream_, event_;  /* the handles are addresses */
static uint64_t format_ = MONO12, locked_, number_;
static double exposure_us_ = 10000.0;
static Buffer *buffers_[MAX_BUFFERS], *queue_[MAX_BUFFERS], *done_[MAX_BUFFERS];
static int n_buffers_, n_queue_, n_done_, running_, killed_;
static pthread_t thread_;
static pthread_mutex_t mutex_ = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t more_ = PTHREAD_COND_INITIALIZER;

static int32_t put(int32_t kind, const void *value, size_t size, int32_t *type, void *out, size_t *n) {
    if (type) *type = kind;
    if (!out) { *n = size; return OK; }
    if (*n < size) return TOO_SMALL;
    memcpy(out, value, size);
    *n = size;
    return OK;
}
static int32_t text(const char *value, int32_t *type, void *out, size_t *n) {
    return put(STRING, value, strlen(value) + 1, type, out, n);
}
static int32_t u32(uint32_t v, int32_t *t, void *o, size_t *n) { return put(UINT32, &v, 4, t, o, n); }
static int32_t i32(int32_t v, int32_t *t, void *o, size_t *n) { return put(INT32, &v, 4, t, o, n); }
static int32_t u64(uint64_t v, int32_t *t, void *o, size_t *n) { return put(UINT64, &v, 8, t, o, n); }
static int32_t big(size_t v, int32_t *t, void *o, size_t *n) { return put(SIZET, &v, 8, t, o, n); }
static int32_t yes(uint8_t v, int32_t *t, void *o, size_t *n) { return put(BOOL8, &v, 1, t, o, n); }
static int32_t ptr(void *v, int32_t *t, void *o, size_t *n) { return put(PTR, &v, 8, t, o, n); }

static size_t payload(void) {
    size_t pixels = WIDTH * HEIGHT;
    return format_ == MONO8 ? pixels : format_ == MONO12 ? 2 * pixels : 3 * pixels / 2;
}
static void draw(Buffer *b) {
    for (int k = 0; k < WIDTH * HEIGHT; k++) {
        unsigned dn = (k % WIDTH + 7 * (k / WIDTH) + b->number) % 4096;
        if (format_ == MONO8) b->data[k] = dn >> 4;
        else if (format_ == MONO12) { b->data[2 * k] = dn; b->data[2 * k + 1] = dn >> 8; }
        else {
            uint8_t *three = b->data + k / 2 * 3;
            if (k % 2) { three[1] |= (dn & 15) << 4; three[2] = dn >> 4; }
            else { three[0] = dn >> 4; three[1] = dn & 15; }
        }
    }
    b->filled = payload();
}
static void *expose(void *none) {
    const char *planted = getenv("GENTL_TEST_INCOMPLETE");
    uint64_t incomplete = planted ? strtoull(planted, 0, 10) : 0;
    struct timespec pause = {0, PERIOD_MS * 1000000L}, now;
    (void)none;
    while (running_) {
        nanosleep(&pause, 0);
        pthread_mutex_lock(&mutex_);
        if (n_queue_) {
            Buffer *b = queue_[0];
            memmove(queue_, queue_ + 1, --n_queue_ * sizeof *queue_);
            clock_gettime(CLOCK_MONOTONIC, &now);
            b->stamp_ns = now.tv_sec * 1000000000ull + now.tv_nsec;
            b->number = ++number_;
            b->incomplete = b->number <= incomplete;
            b->queued = 0;
            draw(b);
            done_[n_done_++] = b;
            pthread_cond_broadcast(&more_);
        }
        pthread_mutex_unlock(&mutex_);
    }
    return 0;
}

API GCInitLib(void) { return OK; }
API GCCloseLib(void) { return OK; }
static int32_t about(int32_t cmd, int32_t *t, void *o, size_t *n) {
    switch (cmd) {
    case 0: return text("test.cti", t, o, n);
    case 1: return text("Test", t, o, n);
    case 2: return text("Producer", t, o, n);
    case 3: return text("1.0", t, o, n);
    case 4: return text("Custom", t, o, n);
    case 5: case 6: case 7: return text("test.cti", t, o, n);
    case 8: return i32(0, t, o, n);
    case 9: return u32(1, t, o, n);
    case 10: return u32(5, t, o, n);
    }
    return NOT_IMPLEMENTED;
}
API GCGetInfo(int32_t cmd, int32_t *t, void *o, size_t *n) { return about(cmd, t, o, n); }
API GCGetLastError(int32_t *code, char *words, size_t *n) {
    if (code) *code = ERROR;
    return text("test", 0, words, n);
}
API TLOpen(void **h) { *h = &system_; return OK; }
API TLClose(void *h) { (void)h; return OK; }
API TLGetInfo(void *h, int32_t c, int32_t *t, void *o, size_t *n) { (void)h; return about(c, t, o, n); }
API TLUpdateInterfaceList(void *h, uint8_t *changed, uint64_t ms) { (void)h; (void)ms; if (changed) *changed = 1; return OK; }
API TLGetNumInterfaces(void *h, uint32_t *n) { (void)h; *n = 1; return OK; }
API TLGetInterfaceID(void *h, uint32_t k, char *o, size_t *n) { (void)h; return k ? INVALID_INDEX : text("IF", 0, o, n); }
static int32_t interface_info(int32_t c, int32_t *t, void *o, size_t *n) {
    return c == 2 ? text("Custom", t, o, n) : c < 2 ? text("IF", t, o, n) : NOT_IMPLEMENTED;
}
API TLGetInterfaceInfo(void *h, const char *id, int32_t c, int32_t *t, void *o, size_t *n) { (void)h; (void)id; return interface_info(c, t, o, n); }
API TLOpenInterface(void *h, const char *id, void **i) { (void)h; (void)id; *i = &interface_; return OK; }
API IFClose(void *h) { (void)h; return OK; }
API IFGetInfo(void *h, int32_t c, int32_t *t, void *o, size_t *n) { (void)h; return interface_info(c, t, o, n); }
API IFUpdateDeviceList(void *h, uint8_t *changed, uint64_t ms) { (void)h; (void)ms; if (changed) *changed = 1; return OK; }
API IFGetNumDevices(void *h, uint32_t *n) { (void)h; *n = 1; return OK; }
API IFGetDeviceID(void *h, uint32_t k, char *o, size_t *n) { (void)h; return k ? INVALID_INDEX : text("DEV-1", 0, o, n); }
static int32_t device_info(int32_t c, int32_t *t, void *o, size_t *n) {
    switch (c) {
    case 0: return text("DEV-1", t, o, n);
    case 1: return text("Test", t, o, n);
    case 2: return text("Synthetic", t, o, n);
    case 3: return text("Custom", t, o, n);
    case 4: return text("Synthetic camera", t, o, n);
    case 5: return i32(1, t, o, n);
    case 7: return text("S42", t, o, n);
    case 9: return u64(1000000000ull, t, o, n);
    }
    return NOT_AVAILABLE;
}
API IFGetDeviceInfo(void *h, const char *id, int32_t c, int32_t *t, void *o, size_t *n) { (void)h; (void)id; return device_info(c, t, o, n); }
API IFOpenDevice(void *h, const char *id, int32_t flags, void **d) { (void)h; (void)id; (void)flags; *d = &device_; return OK; }
API IFGetParentTL(void *h, void **p) { (void)h; *p = &system_; return OK; }
API DevClose(void *h) { (void)h; return OK; }
API DevGetInfo(void *h, int32_t c, int32_t *t, void *o, size_t *n) { (void)h; return device_info(c, t, o, n); }
API DevGetPort(void *h, void **p) { (void)h; *p = &remote_; return OK; }
API DevGetNumDataStreams(void *h, uint32_t *n) { (void)h; *n = 1; return OK; }
API DevGetDataStreamID(void *h, uint32_t k, char *o, size_t *n) { (void)h; return k ? INVALID_INDEX : text("DS", 0, o, n); }
API DevOpenDataStream(void *h, const char *id, void **s) { (void)h; (void)id; *s = &stream_; return OK; }
API DevGetParentIF(void *h, void **p) { (void)h; *p = &interface_; return OK; }
API DSGetParentDev(void *h, void **p) { (void)h; *p = &device_; return OK; }
API DSClose(void *h) { (void)h; return OK; }
API DSGetInfo(void *h, int32_t c, int32_t *t, void *o, size_t *n) {
    (void)h;
    switch (c) {
    case 0: return text("DS", t, o, n);
    case 1: return u64(number_, t, o, n);
    case 2: return u64(0, t, o, n);
    case 3: return big(n_buffers_, t, o, n);
    case 4: return big(n_queue_, t, o, n);
    case 5: return big(n_done_, t, o, n);
    case 6: return u64(number_, t, o, n);
    case 7: return big(payload(), t, o, n);
    case 8: return yes(running_, t, o, n);
    case 9: return yes(1, t, o, n);
    case 10: return text("Custom", t, o, n);
    case 12: return big(1, t, o, n);
    case 13: return big(1, t, o, n);
    }
    return NOT_IMPLEMENTED;
}
static int32_t announce(uint8_t *data, size_t size, void *priv, int own, void **h) {
    if (n_buffers_ == MAX_BUFFERS) return ERROR;
    Buffer *b = calloc(1, sizeof *b);
    b->data = data; b->size = size; b->priv = priv; b->own = own;
    *h = buffers_[n_buffers_++] = b;
    return OK;
}
API DSAnnounceBuffer(void *h, void *data, size_t size, void *priv, void **b) { (void)h; return announce(data, size, priv, 0, b); }
API DSAllocAndAnnounceBuffer(void *h, size_t size, void *priv, void **b) { (void)h; return announce(malloc(size), size, priv, 1, b); }
API DSQueueBuffer(void *h, void *buffer) {
    Buffer *b = buffer;
    (void)h;
    pthread_mutex_lock(&mutex_);
    if (!b->queued) { b->queued = 1; queue_[n_queue_++] = b; }
    pthread_mutex_unlock(&mutex_);
    return OK;
}
API DSFlushQueue(void *h, int32_t kind) {
    (void)h;
    pthread_mutex_lock(&mutex_);
    if (kind == 2 || kind == 3) {
        for (int k = 0; k < n_buffers_; k++)
            if (!buffers_[k]->queued) { buffers_[k]->queued = 1; queue_[n_queue_++] = buffers_[k]; }
        n_done_ = 0;
    } else if (kind == 1) n_done_ = 0;
    else if (kind == 4) {
        n_done_ = n_queue_ = 0;
        for (int k = 0; k < n_buffers_; k++) buffers_[k]->queued = 0;
    }
    pthread_mutex_unlock(&mutex_);
    return OK;
}
API DSRevokeBuffer(void *h, void *buffer, void **data, void **priv) {
    Buffer *b = buffer;
    (void)h;
    for (int k = 0; k < n_buffers_; k++)
        if (buffers_[k] == b) { memmove(buffers_ + k, buffers_ + k + 1, (--n_buffers_ - k) * sizeof *buffers_); break; }
    if (data) *data = b->own ? 0 : b->data;
    if (priv) *priv = b->priv;
    if (b->own) free(b->data);
    free(b);
    return OK;
}
API DSStartAcquisition(void *h, int32_t flags, uint64_t count) {
    (void)h; (void)flags; (void)count;
    running_ = 1;
    return pthread_create(&thread_, 0, expose, 0) ? ERROR : OK;
}
API DSStopAcquisition(void *h, int32_t flags) {
    (void)h; (void)flags;
    if (running_) { running_ = 0; pthread_join(thread_, 0); }
    return OK;
}
API DSGetBufferID(void *h, uint32_t k, void **b) { (void)h; if (k >= (uint32_t)n_buffers_) return INVALID_INDEX; *b = buffers_[k]; return OK; }
API DSGetBufferInfo(void *h, void *buffer, int32_t c, int32_t *t, void *o, size_t *n) {
    Buffer *b = buffer;
    (void)h;
    switch (c) {
    case 0: return ptr(b->data, t, o, n);
    case 1: return big(b->size, t, o, n);
    case 2: return ptr(b->priv, t, o, n);
    case 3: case 28: return u64(b->stamp_ns, t, o, n);
    case 4: return yes(1, t, o, n);
    case 5: return yes(b->queued, t, o, n);
    case 6: return yes(0, t, o, n);
    case 7: return yes(b->incomplete, t, o, n);
    case 8: return text("Custom", t, o, n);
    case 9: case 27: return big(b->filled, t, o, n);
    case 10: return big(WIDTH, t, o, n);
    case 11: case 22: return big(HEIGHT, t, o, n);
    case 12: case 13: case 14: case 15: case 18: return big(0, t, o, n);
    case 16: return u64(b->number, t, o, n);
    case 17: return yes(1, t, o, n);
    case 19: return big(1, t, o, n);
    case 20: return u64(format_, t, o, n);
    case 21: return u64(1, t, o, n);
    case 26: return i32(1, t, o, n);
    case 29: case 30: return yes(0, t, o, n);
    }
    return NOT_AVAILABLE;
}
API GCRegisterEvent(void *source, int32_t kind, void **event) { (void)source; (void)kind; killed_ = 0; *event = &event_; return OK; }
API GCUnregisterEvent(void *source, int32_t kind) { (void)source; (void)kind; return OK; }
API EventGetData(void *event, void *out, size_t *n, uint64_t ms) {
    struct timespec until;
    int32_t status = TIMEOUT;
    (void)event;
    clock_gettime(CLOCK_REALTIME, &until);
    if (ms > 1000000) ms = 1000000;
    until.tv_sec += ms / 1000;
    until.tv_nsec += ms % 1000 * 1000000;
    if (until.tv_nsec >= 1000000000) { until.tv_sec++; until.tv_nsec -= 1000000000; }
    pthread_mutex_lock(&mutex_);
    while (!n_done_ && !killed_)
        if (pthread_cond_timedwait(&more_, &mutex_, &until)) break;
    if (n_done_) {
        void *pair[2] = {done_[0], done_[0]->priv};
        memmove(done_, done_ + 1, --n_done_ * sizeof *done_);
        status = put(0, pair, sizeof pair, 0, out, n);
    } else if (killed_) status = -1012;
    pthread_mutex_unlock(&mutex_);
    return status;
}
API EventGetDataInfo(void *event, const void *in, size_t size, int32_t c, int32_t *t, void *o, size_t *n) {
    (void)event; (void)size;
    return c == 0 ? ptr(*(void *const *)in, t, o, n) : c == 1 ? ptr(((void *const *)in)[1], t, o, n) : NOT_IMPLEMENTED;
}
API EventGetInfo(void *event, int32_t c, int32_t *t, void *o, size_t *n) {
    (void)event;
    switch (c) {
    case 0: return i32(1, t, o, n);
    case 1: return big(n_done_, t, o, n);
    case 2: return u64(number_, t, o, n);
    case 3: case 4: return big(16, t, o, n);
    }
    return NOT_IMPLEMENTED;
}
API EventFlush(void *event) { (void)event; pthread_mutex_lock(&mutex_); n_done_ = 0; pthread_mutex_unlock(&mutex_); return OK; }
API EventKill(void *event) { (void)event; killed_ = 1; pthread_cond_broadcast(&more_); return OK; }

static void *reg(uint64_t address) {
    static uint64_t none, size;
    switch (address) {
    case R_FORMAT: return &format_;
    case R_EXPOSURE: return &exposure_us_;
    case R_LOCKED: return &locked_;
    case R_START: case R_STOP: return &none;
    case R_PAYLOAD: size = payload(); return &size;
    }
    return 0;
}
API GCReadPort(void *port, uint64_t address, void *out, size_t *n) {
    const char *xml = port == &remote_ ? XML : EMPTY;
    size_t size = strlen(xml);
    if (address >= XML_AT && address < XML_AT + size) {
        size_t left = XML_AT + size - address;
        memset(out, 0, *n);
        memcpy(out, xml + (address - XML_AT), *n < left ? *n : left);
        return OK;
    }
    void *at = port == &remote_ ? reg(address) : 0;
    if (!at || *n > 8) return INVALID_ADDRESS;
    memcpy(out, at, *n);
    return OK;
}
API GCWritePort(void *port, uint64_t address, const void *in, size_t *n) {
    void *at = port == &remote_ ? reg(address) : 0;
    if (!at || *n > 8) return INVALID_ADDRESS;
    memcpy(at, in, *n);
    return OK;
}
API GCGetPortURL(void *port, char *o, size_t *n) {
    char url[64];
    snprintf(url, sizeof url, "Local:test.xml;%X;%zX", XML_AT, strlen(port == &remote_ ? XML : EMPTY));
    return text(url, 0, o, n);
}
API GCGetNumPortURLs(void *port, uint32_t *n) { (void)port; *n = 1; return OK; }
API GCGetPortURLInfo(void *port, uint32_t k, int32_t c, int32_t *t, void *o, size_t *n) {
    size_t size = strlen(port == &remote_ ? XML : EMPTY);
    char url[64];
    if (k) return INVALID_INDEX;
    snprintf(url, sizeof url, "Local:test.xml;%X;%zX", XML_AT, size);
    switch (c) {
    case 0: return text(url, t, o, n);
    case 1: case 2: return i32(1, t, o, n);
    case 3: return i32(1, t, o, n);
    case 4: case 5: return i32(0, t, o, n);
    case 7: return u64(XML_AT, t, o, n);
    case 8: return u64(size, t, o, n);
    case 9: return i32(0, t, o, n);
    case 10: return text("test.xml", t, o, n);
    }
    return NOT_AVAILABLE;
}
API GCGetPortInfo(void *port, int32_t c, int32_t *t, void *o, size_t *n) {
    const char *module = port == &remote_ ? "Device" : port == &device_ ? "TLDevice" : port == &stream_ ? "TLDataStream" : port == &interface_ ? "TLInterface" : port == &system_ ? "TLSystem" : "Buffer";
    switch (c) {
    case 0: case 12: return text(port == &remote_ ? "Device" : "Port", t, o, n);
    case 1: return text("Test", t, o, n);
    case 2: return text("Synthetic", t, o, n);
    case 3: return text("Custom", t, o, n);
    case 4: return text(module, t, o, n);
    case 5: case 7: case 8: return yes(1, t, o, n);
    case 6: case 9: case 10: return yes(0, t, o, n);
    case 11: return text("1.0", t, o, n);
    }
    return NOT_IMPLEMENTED;
}
API GCReadPortStacked(void *p, void *e, size_t *n) { (void)p; (void)e; (void)n; return NOT_IMPLEMENTED; }
API GCWritePortStacked(void *p, void *e, size_t *n) { (void)p; (void)e; (void)n; return NOT_IMPLEMENTED; }
API DSGetBufferChunkData(void *h, void *b, void *o, size_t *n) { (void)h; (void)b; (void)o; if (n) *n = 0; return NOT_AVAILABLE; }
API DSGetNumBufferParts(void *h, void *b, uint32_t *n) { (void)h; (void)b; *n = 0; return NOT_AVAILABLE; }
API DSGetBufferPartInfo(void *h, void *b, uint32_t k, int32_t c, int32_t *t, void *o, size_t *n) { (void)h; (void)b; (void)k; (void)c; (void)t; (void)o; (void)n; return NOT_AVAILABLE; }
